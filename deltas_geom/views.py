"""Posed views: intrinsics and poses of V cameras that look at one world."""

from typing import NamedTuple, Self

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from deltas_geom.checks import ShapeError, check_shapes
from deltas_geom.pixels import crop_intrinsics, resize_intrinsics
from deltas_geom.poses import invert_pose, is_rigid
from deltas_geom.precision import promoted, without_autocast


class PosedViews(NamedTuple):
    """V pinhole cameras; view 0 is the anchor, the others are its sources.

    Attributes:
        K: ``(*B, V, 3, 3)`` intrinsics in pixels; pixel centres are integers.
        cam_from_world: ``(*B, V, 4, 4)`` rigid, OpenCV axes (x right, y down, z forward),
            metres.

    Example:
        >>> K = torch.tensor([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]]).expand(2, 3, 3)
        >>> pose = torch.eye(4).repeat(2, 1, 1)
        >>> pose[1, 0, 3] = -0.2  # the second camera stands 20 cm to the right
        >>> PosedViews(K, pose).proj.shape
        torch.Size([2, 3, 4])
    """

    K: Tensor
    cam_from_world: Tensor

    @property
    @without_autocast
    def proj(self) -> Tensor:
        """Projection matrices K [R | t], ``(*B, V, 3, 4)``, in the dtype to which both promote."""
        check_shapes(K=(self.K, "V 3 3"), cam_from_world=(self.cam_from_world, "V 4 4"))
        K, cam_from_world = promoted(*self)
        return K @ cam_from_world[..., :3, :]

    @property
    def num_views(self) -> int:
        """How many views there are, the anchor included."""
        return self.K.shape[-3]

    @classmethod
    def from_world_from_cam(cls, K: Tensor, world_from_cam: Tensor) -> Self:
        """From camera-to-world poses, as ScanNet, 7-Scenes and most trackers write them."""
        return cls(K, invert_pose(world_from_cam))

    @classmethod
    def from_opengl(cls, K: Tensor, world_from_cam: Tensor) -> Self:
        """From camera-to-world poses with OpenGL axes (x right, y up, z backward).

        Blender, NeRF's ``transforms.json`` and ARKit write these. The world stays as it is.
        """
        x, y, z, center = world_from_cam.unbind(dim=-1)
        return cls(K, invert_pose(torch.stack([x, -y, -z, center], dim=-1)))

    @classmethod
    def from_kornia(cls, camera: PinholeCamera, *, num_views: int | None = None) -> Self:
        """From a kornia camera, whose single batch dim is read as ``(B * V)``.

        Args:
            camera: kornia camera; its extrinsics are camera-from-world as ours.
            num_views: V; without it all cameras are views of one world.
        """
        K = camera.intrinsics[..., :3, :3]
        views = num_views or K.shape[0]
        if K.shape[0] % views:
            raise ShapeError(f"{K.shape[0]} kornia cameras are no multiple of num_views={views}")
        batch = () if num_views is None else (K.shape[0] // views,)
        return cls(K.reshape(*batch, views, 3, 3), camera.extrinsics.reshape(*batch, views, 4, 4))

    def to_kornia(self, *, image_size: tuple[int, int]) -> PinholeCamera:
        """As a kornia camera with all leading dims flattened into its one batch dim."""
        K = self.K.reshape(-1, 3, 3)
        intrinsics = torch.eye(4, device=K.device, dtype=K.dtype).repeat(K.shape[0], 1, 1)
        intrinsics[:, :3, :3] = K
        height, width = (K.new_full((K.shape[0],), float(size)) for size in image_size)
        return PinholeCamera(intrinsics, self.cam_from_world.reshape(-1, 4, 4), height, width)

    def select(self, index: int | slice | list[int]) -> Self:
        """The chosen views; an int keeps the view dim (V = 1)."""
        if isinstance(index, int):
            # Not a list, which is copied to the device and waited for.
            return type(self)(*(tensor.select(-3, index).unsqueeze(-3) for tensor in self))
        return self._replace(
            K=self.K[..., index, :, :], cam_from_world=self.cam_from_world[..., index, :, :]
        )

    def resize(self, *, old_size: tuple[int, int], new_size: tuple[int, int]) -> Self:
        """The same cameras when their images are resized."""
        return self._replace(K=resize_intrinsics(self.K, old_size=old_size, new_size=new_size))

    def crop(self, *, left: float, top: float) -> Self:
        """The same cameras when their images are cropped: pixel (left, top) becomes (0, 0)."""
        return self._replace(K=crop_intrinsics(self.K, left=left, top=top))

    def to(self, *args: torch.device | torch.dtype | str) -> Self:
        """Both tensors moved or cast as by :meth:`torch.Tensor.to`."""
        return self._replace(K=self.K.to(*args), cam_from_world=self.cam_from_world.to(*args))  # type: ignore[call-overload]

    def check_values(self) -> None:
        """Raise ``ValueError`` unless K is an upper triangular camera and poses are rigid.

        Apart from the operations because looking at values stalls an accelerator.
        """
        focal = self.K.diagonal(dim1=-2, dim2=-1)[..., :2]
        lower = torch.stack([self.K[..., 1, 0], self.K[..., 2, 0], self.K[..., 2, 1]])
        if not bool(self.K.isfinite().all()) or not bool((focal > 0).all()):
            raise ValueError("K must be finite with positive focal lengths")
        if bool((lower != 0).any()) or bool((self.K[..., 2, 2] != 1).any()):
            raise ValueError("K must be upper triangular with K[2, 2] = 1")
        if not bool(is_rigid(self.cam_from_world).all()):
            raise ValueError("cam_from_world must hold finite rigid transforms (R orthogonal)")
