"""Each view moves its match a little: a soft-argmax in a small window around the pixel.

The joint decision puts matches on the epipolar lines at one depth. A window along and across
the line finds the rest: what lies between depth samples, and errors of the poses.
"""

import torch
from torch import Tensor, nn

from deltas_geom import Matches, in_image, sample_map, soft_argmax
from deltas_nets.network.layers import WideLinear

_ALONG, _ACROSS = 9, 3


class RefineMatches(nn.Module):
    """Windows of 9 x 3 places around the matches, one pixel to either side of the line."""

    def __init__(self, radius: float) -> None:
        super().__init__()
        along = torch.linspace(-radius, radius, _ALONG)
        across = torch.linspace(-1, 1, _ACROSS)
        window = torch.stack(torch.meshgrid(along, across, indexing="ij"), dim=-1)
        self.register_buffer("window", window.reshape(-1, 2), persistent=False)
        self.window: Tensor
        self.log_scale = nn.Parameter(torch.tensor(2.5))
        # Without evidence the match stays: a Gaussian prior, wider along the line than across.
        self.log_spread = nn.Parameter(torch.tensor([0.0, -0.7]))
        self.trust = WideLinear(3, 1)

    def forward(
        self, matches: Matches, anchor: Tensor, maps: Tensor, *, image_size: tuple[int, int]
    ) -> Matches:
        """Matches with source pixels, weights and covariances from the windows.

        Args:
            matches: the joint decision; a source's covariance tells the line's direction.
            anchor: ``(B, N, D)`` descriptors of the keypoints.
            maps: ``(B, V, D, h, w)`` descriptors of all views.
            image_size: (height, width).
        """
        pixels = matches.pixels[:, 1:]
        direction = _line_direction(matches.covariance[:, 1:])
        normal = torch.stack([-direction[..., 1], direction[..., 0]], dim=-1)
        axes = torch.stack([direction, normal], dim=-2)  # (B, V-1, N, 2, 2)
        window = self.window.to(axes.dtype)
        places = pixels.unsqueeze(-2) + window @ axes
        read = sample_map(maps[:, 1:], places.flatten(-3, -2), image_size=image_size)
        read = read.reshape(*places.shape[:-1], -1)  # (B, V-1, N, 27, D)
        correlation = (read @ anchor[:, None, :, :, None]).squeeze(-1)
        prior = (window * torch.exp(-self.log_spread)).square().sum(-1) / 2
        found = soft_argmax(
            correlation * self.log_scale.exp() - prior,
            places,
            mask=in_image(places, image_size=image_size),
        )
        evidence = torch.stack([correlation.amax(-1), correlation.mean(-1), found.peak], dim=-1)
        weight = self.trust(evidence).squeeze(-1).sigmoid()
        seen = matches.mask[:, 1:]
        moved = torch.where(seen[..., None], found.position, pixels)
        return Matches(
            torch.cat([matches.pixels[:, :1], moved], dim=1),
            torch.cat([matches.weights[:, :1], weight], dim=1),
            torch.cat([matches.covariance[:, :1], found.covariance], dim=1),
            matches.mask,
        )


def _line_direction(covariance: Tensor) -> Tensor:
    """Unit direction ``(..., 2)`` of a rank-one covariance; (1, 0) where it is zero."""
    xx, xy, yy = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    # Half the angle of the doubled vector: no eigenvectors needed in two dimensions.
    angle = torch.atan2(2 * xy, xx - yy).detach() / 2
    return torch.stack([angle.cos(), angle.sin()], dim=-1)
