"""What readers find one by one: frames, those that are lost, images of other sizes than stated."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from deltas_nets.captures.capture import Capture, Lost
from deltas_nets.captures.file_form import OURS, FileForm
from deltas_nets.captures.frame import FloatArray, Frame, Lens
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.images import image_size_of
from deltas_nets.captures.readers.cameras import fitted
from deltas_nets.captures.readers.image_sizes import SizedCamera, doubts_of_sizes
from deltas_nets.captures.readers.names import check_ids
from deltas_nets.captures.readers.poses import missing_images
from deltas_nets.errors import UserError

__all__ = ["Collected", "Photo"]


class Photo(NamedTuple):
    """An image that is there.

    Attributes:
        id: of its frame.
        path: its file.
        size: (height, width) of the file.
    """

    id: str
    path: Path
    size: tuple[int, int]


class Collected:
    """The frames of a capture while it is read.

    Args:
        listed: the file that names the images, or the folder where they should be, for errors.
    """

    def __init__(self, listed: Path) -> None:
        self.listed = listed
        self._frames: list[Frame] = []
        self._lost: dict[str, Lost] = {}
        self._missing: list[str] = []
        self._sized: list[SizedCamera] = []

    def photo(self, id: str, path: Path | None) -> Photo | None:
        """The image of a frame; None where it is not there, or no image: the frame is lost then."""
        size = None if path is None else image_size_of(path)
        if path is None or size is None:
            self._missing.append(id)
            return None
        return Photo(id, path, size)

    def without_pose(self, id: str, error: UserError) -> None:
        """Note a frame whose pose is not known, and what asking for it raises."""
        self._lost[id] = Lost("no pose", error)

    def add(
        self,
        photo: Photo,
        pose: FloatArray | Lost,
        K: FloatArray,
        *,
        stated: tuple[int, int] | None = None,
        lens: Lens | None = None,
        depth: Path | None = None,
    ) -> None:
        """Add a frame, or why its pose is none.

        Args:
            photo: its image.
            pose: ``(4, 4)`` cam_from_world.
            K: ``(3, 3)`` for images of the stated size.
            stated: (height, width); the image's own if not given.
            lens: None where straight lines are straight.
            depth: the file that a sensor's depth is in.

        Raises:
            UserError: the image is no resized version of the stated size.
        """
        if isinstance(pose, Lost):
            self._lost[photo.id] = pose
            return
        if stated is not None:
            self._sized.append(fitted(K, stated, photo.size, image=photo.path))
            K = self._sized[-1].K
        self._frames.append(
            Frame(
                id=photo.id,
                image_path=photo.path,
                image_size=photo.size,
                K=K,
                lens=lens,
                cam_from_world=pose,
                depth_path=depth,
            )
        )

    def capture(
        self,
        folder: Path,
        layout: str,
        *,
        metric: bool,
        doubts: Sequence[str] = (),
        form: FileForm = OURS,
    ) -> Capture:
        """All that was found.

        Args:
            folder: of the capture.
            layout: the format's name.
            metric: whether its unit is the metre.
            doubts: besides those of sizes.
            form: how its files say cameras.

        Raises:
            UserError: no file of results can be called by one of the ids.
        """
        check_ids([frame.id for frame in self._frames], self.listed)
        return Capture(
            folder,
            Frames.of(self._frames, folder),
            {**self._lost, **missing_images(self._missing, self.listed)},
            (*doubts_of_sizes(self._sized), *doubts),
            layout,
            metric,
            form=form,
        )
