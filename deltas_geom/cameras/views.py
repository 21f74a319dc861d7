"""Posed views: intrinsics and poses of V cameras that look at one world."""

import operator
from typing import Self, SupportsIndex

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from deltas_geom.cameras.pixels import crop_intrinsics, resize_intrinsics
from deltas_geom.cameras.posed_shapes import posed_shapes
from deltas_geom.cameras.poses import invert_pose, is_rigid, recentred
from deltas_geom.cameras.pytorch3d import from_pytorch3d
from deltas_geom.checks import ShapeError, check_image_size, check_kind, check_tensor
from deltas_geom.numerics.arithmetic import (
    both,
    finite_or_zero,
    only,
    promoted,
    surely_below,
    without_autocast,
)
from deltas_geom.records import Record


class PosedViews(Record):
    """V pinhole cameras; view 0 is the anchor, the others are its sources.

    Batch dims ``*B`` of K and cam_from_world broadcast, V does not: where all views share one K,
    pass ``K.expand(V, 3, 3)``. Values are looked at by :meth:`check_values` alone. A named
    tuple: ``len(views)`` is 2, its fields; V is :attr:`num_views`.

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

    def __new__(cls, K: Tensor, cam_from_world: Tensor) -> Self:
        """Refuse arrays and lists at once; what stands for tensors, as ``in_dims``, may be any."""
        for name, value in (("K", K), ("cam_from_world", cam_from_world)):
            if isinstance(value, list) or type(value).__name__ == "ndarray":
                check_tensor(**{name: value})
        return tuple.__new__(cls, (K, cam_from_world))

    @property
    @without_autocast
    def proj(self) -> Tensor:
        """Projection matrices K [R | t], ``(*B, V, 3, 4)``, in the dtype to which both promote.

        That of a camera that is not finite is NaN, so that triangulation can tell.
        """
        self.check_shapes()
        K, cam_from_world = promoted(*self)
        (K, known), (poses, posed) = finite_or_zero(K, 2), finite_or_zero(cam_from_world, 2)
        return only(K @ poses[..., :3, :], known, posed, other=torch.nan)

    @property
    def num_views(self) -> int:
        """How many views there are, the anchor included."""
        self.check_shapes()
        return self.K.shape[-3]

    @classmethod
    def from_world_from_cam(cls, K: Tensor, world_from_cam: Tensor) -> Self:
        """From camera-to-world poses, as ScanNet, 7-Scenes and most trackers write them.

        Args:
            K: ``(*B, V, 3, 3)`` intrinsics in pixels.
            world_from_cam: ``(*B, V, 4, 4)`` rigid. A scale in the rotations multiplies every
                depth, without a word: call :meth:`check_values` once.

        Raises:
            ShapeError: a trailing shape differs.
            TypeError: not a tensor.
        """
        posed_shapes(K, world_from_cam, "world_from_cam")
        return cls(K, invert_pose(world_from_cam))

    @classmethod
    def from_opengl(cls, K: Tensor, world_from_cam: Tensor) -> Self:
        """From camera-to-world poses with OpenGL axes (x right, y up, z backward).

        Blender, NeRF's ``transforms.json`` and ARKit write these. The world stays as it is.
        Arguments and errors are those of :meth:`from_world_from_cam`; docs/conventions.md has a
        ``transforms.json`` read whole, K included.

        Example:
            >>> K = torch.tensor([[[100.0, 0, 50], [0, 100, 40], [0, 0, 1]]])
            >>> views = PosedViews.from_opengl(K, torch.eye(4)[None])
            >>> views.check_values()
            >>> views.cam_from_world[0].diagonal()
            tensor([ 1., -1., -1.,  1.])
        """
        posed_shapes(K, world_from_cam, "world_from_cam")
        x, y, z, center = world_from_cam.unbind(dim=-1)
        return cls(K, invert_pose(torch.stack([x, -y, -z, center], dim=-1)))

    @classmethod
    def from_pytorch3d(
        cls,
        R: Tensor,
        T: Tensor,
        focal_length: Tensor,
        principal_point: Tensor,
        *,
        image_size: tuple[int, int],
    ) -> Self:
        """From a PyTorch3D ``PerspectiveCameras`` in NDC, as its constructor takes them.

        There points are rows, X_cam = X_world R + T; x points left, y up, z forward; and NDC goes
        from -1 to 1 over the shorter side of the image.

        Args:
            R: ``(*B, V, 3, 3)`` rotations.
            T: ``(*B, V, 3)`` translations, metres.
            focal_length: ``(*B, V, 2)`` in NDC. Of a camera made with ``in_ndc=False`` pass
                2 f / min(H, W), f being in pixels.
            principal_point: ``(*B, V, 2)`` in NDC, x left and y up of the middle. Of
                ``in_ndc=False`` pass (W - 2 px, H - 2 py) / min(H, W).
            image_size: (height, width).

        Raises:
            ShapeError: a trailing shape differs, or batch dims do not broadcast.

        Source: PyTorch3D's ``cameras_from_opencv_projection``, the other way.
        """
        return cls(*from_pytorch3d(R, T, focal_length, principal_point, image_size))

    @classmethod
    def from_kornia(cls, camera: PinholeCamera, *, num_views: int | None = None) -> Self:
        """From a kornia camera, whose single batch dim is read as ``(B * V)``.

        Args:
            camera: kornia camera; its extrinsics are camera-from-world as ours.
            num_views: V; without it all cameras are views of one world.

        Raises:
            ShapeError: no multiple of ``num_views``, or no camera.
            ValueError: ``num_views`` is below 1.
        """
        K = camera.intrinsics[..., :3, :3]
        batch: tuple[int, ...] = ()
        views = K.shape[0]
        if num_views is not None:
            if num_views < 1:
                raise ValueError(f"num_views must be at least 1, or None for all, got {num_views}")
            if K.shape[0] % num_views:
                raise ShapeError(
                    f"{K.shape[0]} kornia cameras are no multiple of num_views={num_views}"
                )
            batch, views = (K.shape[0] // num_views,), num_views
        elif views == 0:
            raise ShapeError("camera must hold at least one view, got a kornia camera of none")
        return cls(K.reshape(*batch, views, 3, 3), camera.extrinsics.reshape(*batch, views, 4, 4))

    def to_kornia(self, *, image_size: tuple[int, int]) -> PinholeCamera:
        """As a kornia camera with all leading dims flattened into its one batch dim.

        Args:
            image_size: (height, width) of the images.

        Raises:
            ShapeError: K and cam_from_world do not go together.
        """
        check_image_size(image_size)
        batch = self.check_shapes()
        K, cam_from_world = (
            # The count, not -1: a reshape of nothing cannot infer it.
            tensor.expand(*batch, *tensor.shape[-3:]).reshape(
                batch.numel() * tensor.shape[-3], *tensor.shape[-2:]
            )
            for tensor in promoted(*self)
        )
        intrinsics = torch.eye(4, device=K.device, dtype=K.dtype).repeat(K.shape[0], 1, 1)
        intrinsics[:, :3, :3] = K
        height, width = (K.new_full((K.shape[0],), float(size)) for size in image_size)
        return PinholeCamera(intrinsics, cam_from_world, height, width)

    def select(self, index: SupportsIndex | slice | list[int]) -> Self:
        """The chosen views; an integer of any kind keeps the view dim (V = 1)."""
        self.check_shapes()
        # Arrays have __index__, too, and a list of one view in an array is no integer.
        if hasattr(index, "__index__") and getattr(index, "ndim", 0) == 0:
            view = operator.index(index)
            # Not a list, which is copied to the device and waited for.
            return type(self)(*(tensor.select(-3, view).unsqueeze(-3) for tensor in self))
        return type(self)(*(tensor[..., index, :, :] for tensor in self))

    def resize(self, *, old_size: tuple[int, int], new_size: tuple[int, int]) -> Self:
        """The same cameras when their images are resized."""
        return self._replace(K=resize_intrinsics(self.K, old_size=old_size, new_size=new_size))

    def crop(self, *, left: float, top: float) -> Self:
        """The same cameras when their images are cropped: pixel (left, top) becomes (0, 0)."""
        return self._replace(K=crop_intrinsics(self.K, left=left, top=top))

    def recentred(self, view: int | None = 0) -> tuple[Self, Tensor]:
        """The same cameras in a world whose origin is a camera's centre, or the mean of centres.

        For coordinates far from their origin, as of maps: 500 km are known to 3 cm in float32. Do
        it in float64, and cast what comes of it.

        Args:
            view: whose centre becomes the origin; None takes the mean of all.

        Returns:
            Views, and the offset ``(*B, 3)``, metres: points of the old world are those of the new
            one plus the offset. It is 0 where that centre is not finite.

        Example:
            >>> poses = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
            >>> poses[:, 0, 3] = torch.tensor([-500000.25, -500000.5])
            >>> views, offset = PosedViews(torch.eye(3).repeat(2, 1, 1), poses).recentred()
            >>> offset[0].item(), views.cam_from_world[1, 0, 3].item()
            (500000.25, -0.25)
        """
        self.check_shapes()
        moved, offset = recentred(self.cam_from_world, view)
        return self._replace(cam_from_world=moved), offset

    def check_shapes(self) -> torch.Size:
        """``*B``, to which K and cam_from_world broadcast.

        Raises:
            ShapeError: a trailing shape differs, each has another V, or ``*B`` does not broadcast.
            TypeError: not a tensor, or of integers.
        """
        return posed_shapes(self.K, self.cam_from_world, "cam_from_world")

    def check_values(self) -> None:
        """Raise ``ValueError`` unless K is an upper triangular camera and poses are rigid.

        Call it once where cameras are read: no operation looks at values, as that stalls an
        accelerator. It names a view and what is wrong: a scale, a shear or a mirror, a last row
        that is not (0, 0, 0, 1), K transposed or not scaled to K[2, 2] = 1, NaN and infinity.
        """
        try:
            self.check_shapes()
        except TypeError as error:
            raise ValueError(str(error)) from error
        K, pose = self
        lower = torch.stack([K[..., 1, 0], K[..., 2, 0], K[..., 2, 1], K[..., 2, 2] - 1], dim=-1)
        off = (pose[..., 3, :].float() - torch.eye(4, device=pose.device)[3]).abs()
        det = torch.linalg.det(pose[..., :3, :3].float().nan_to_num())
        for wanted, good in (
            ("K must be finite", K.isfinite().all(-1)),
            ("K must have positive focal lengths", K.diagonal(dim1=-2, dim2=-1)[..., :2] > 0),
            ("K must be upper triangular with K[2, 2] = 1", lower == 0),
            ("cam_from_world must be finite", pose.isfinite().all(-1)),
            ("cam_from_world must be rigid, with the last row 0 0 0 1", off <= 1e-3),
            ("cam_from_world must be rigid, no mirror", det[..., None] > 0),
            ("cam_from_world must be rigid, R orthogonal, no scale", is_rigid(pose)[..., None]),
        ):
            if not bool(good.all()):
                raise ValueError(f"{wanted}: not so in view {int((~good).nonzero()[0, -2])}")


def finite_views(views: PosedViews) -> tuple[tuple[Tensor, Tensor], Tensor | None, torch.Size]:
    """Cameras to compute with: an identity, without gradient, in place of what is not finite.

    Nor is a camera whose numbers are so large that a product of four has none.

    Returns:
        K and poses, which were finite ``(*B, V, 1, 1)`` bool or None if all, and ``*B``.

    Raises:
        ShapeError: as :meth:`PosedViews.check_shapes`.
        TypeError: not posed views.
    """
    check_kind("views", views, PosedViews, "PosedViews(K, cam_from_world)")
    batch = views.check_shapes()
    poses = views.cam_from_world
    poses, posed = finite_or_zero(poses, dims=2, limit=torch.finfo(poses.dtype).max ** 0.25)
    K, known = finite_intrinsics(views.K)
    return (K, poses), both(known, posed), batch


def finite_intrinsics(K: Tensor) -> tuple[Tensor, Tensor | None]:
    """Intrinsics to divide by, an identity in place of what is no camera, and which are one."""
    plain = K.detach()
    focal, most = plain.diagonal(dim1=-2, dim2=-1), torch.finfo(K.dtype).max ** 0.25
    # Then the product of two is not 0, either.
    if surely_below(plain, most) and surely_below(focal.reciprocal(), most):
        return K, None
    known = (plain.abs().amax(dim=(-2, -1)) < most) & (focal[..., 0] * focal[..., 1] != 0)
    known = known[..., None, None]
    return torch.where(known, K, torch.eye(3, device=K.device, dtype=K.dtype)), known
