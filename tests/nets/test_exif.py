"""Photos that EXIF says are to be turned, among upright ones."""

from pathlib import Path

import pytest
from conftest import MakeCapture
from PIL import ExifTags, Image

from deltas_nets.captures.capture import Capture
from deltas_nets.captures.opening import open_capture
from deltas_nets.check.image_sizes import wrong_sizes
from deltas_nets.errors import UserError


def turned(make_capture: MakeCapture, *, exif: bool) -> Capture:
    """Four frames, of which the file of frame 2 is turned."""
    folder = make_capture()
    file: Path = folder / "color" / "2.jpg"
    image = Image.open(file).transpose(Image.Transpose.ROTATE_90)
    said = image.getexif()
    if exif:
        said[ExifTags.Base.Orientation] = 6
    image.save(file, exif=said)
    return open_capture(folder)


@pytest.mark.parametrize("exif", [True, False])
def test_exif_is_named_where_it_turns_one_of_them(make_capture: MakeCapture, exif: bool) -> None:
    capture = turned(make_capture, exif=exif)
    with pytest.raises(UserError) as raised:
        capture.frame(2).read_image()
    assert ("EXIF" in f"{raised.value.what} {raised.value.remedy}") is exif
    (found,) = wrong_sizes(capture)
    assert found.frames == ("2",) and ("turn 2 as EXIF says" in found.cure) is exif
