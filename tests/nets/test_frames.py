"""Frames: any cameras, any ids, in the order in which people count; and readers of them."""

import dataclasses
import operator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from deltas_nets.captures import opening
from deltas_nets.captures.capture import Capture, Lost
from deltas_nets.captures.frame import Frame, Lens
from deltas_nets.captures.frames import Frames
from deltas_nets.captures.ids import id_in_json, natural_key
from deltas_nets.errors import UserError

names = st.text("ab/_.é 0123456789", min_size=1, max_size=8).filter(lambda name: name.strip("/ ."))


@st.composite
def frame(draw: st.DrawFn, id: str) -> Frame:
    """A frame of one of a few cameras, with or without depth, in the folder or not."""
    height, width = draw(st.sampled_from([(48, 64), (64, 48), (30, 40)]))
    K = np.array([[draw(st.sampled_from([60.0, 61.0])), 0, 31.5], [0, 60, 23.5], [0, 0, 1]])
    pose = np.eye(4)
    pose[0, 3] = draw(st.floats(-9, 9))
    folder = draw(st.sampled_from([Path("scene"), Path("/elsewhere")]))
    depth = folder / "depth" / f"{draw(names)}.png" if draw(st.booleans()) else None
    lens = draw(st.sampled_from([None, Lens("SIMPLE_RADIAL", (0.1,))]))
    size = None if depth is None else (24, 32)
    image = folder / f"{draw(names)}.jpg"
    return Frame(id, image, (height, width), K, pose, depth, None, size, lens)


@given(data=st.data(), ids=st.lists(names, unique=True, max_size=6))
def test_frames_come_out_as_they_went_in(data: st.DataObject, ids: list[str]) -> None:
    frames = {id: data.draw(frame(id)) for id in ids}
    packed = Frames.of(frames.values(), Path("scene"))
    assert list(packed) == sorted(ids, key=natural_key) and len(packed) == len(ids)
    for position, id in enumerate(packed):
        for field in dataclasses.fields(Frame):
            found, expected = (getattr(one, field.name) for one in (packed[id], frames[id]))
            same = np.array_equal if isinstance(expected, np.ndarray) else operator.eq
            assert same(found, expected), field.name
        assert packed.id_at(position) == id and np.array_equal(packed.K[position], frames[id].K)
        assert tuple(packed.image_sizes[position]) == frames[id].image_size
    mask = np.array([len(id) > 3 for id in packed], dtype=bool)
    assert list(packed.kept(mask)) == [id for id in packed if len(id) > 3]


def test_numbers_inside_of_ids_count_as_numbers() -> None:
    ordered = ["2", "10", "a", "a2", "a10", "a10b"]
    assert sorted(ordered[::-1], key=natural_key) == ordered


@given(id=st.one_of(names, st.integers(-99, 10**6).map(str)))
def test_ids_survive_json(id: str) -> None:
    assert str(id_in_json(id)) == id


class Lists:
    """A reader: a folder with a file frames.txt, an id on each line, "!" before one that is bad."""

    def recognises(self, path: Path) -> bool:
        return (path / "frames.txt").exists()

    def read(self, path: Path) -> Capture:
        ids = (path / "frames.txt").read_text().split()
        why = {"?": "no pose", "!": "malformed"}
        lost = {
            id[1:]: Lost(why[id[0]], UserError(f"frame {id[1:]}", path / "frames.txt", "mend it"))  # type: ignore[arg-type]
            for id in ids
            if id[0] in why
        }
        kept = [id for id in ids if id[0] not in why]
        frames = [Frame(id, path / id, (48, 64), np.eye(3), np.eye(4)) for id in kept]
        return Capture(path, Frames.of(frames, path), lost)


def test_a_reader_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opening, "READERS", (*opening.READERS, Lists()))
    with pytest.raises(UserError) as error:
        opening.open_capture(tmp_path)
    assert "docs/captures.md" in error.value.remedy
    file = tmp_path / "frames.txt"
    file.write_text("left ?lost right")
    capture = opening.open_capture(tmp_path)
    assert (list(capture.frames), list(capture.lost)) == (["left", "right"], ["lost"])
    assert capture.frame("left").image_path == tmp_path / "left"
    for content, what in (("left !bad", "frame bad"), ("?lost", "every pose is lost")):
        file.write_text(content)
        with pytest.raises(UserError) as error:
            opening.open_capture(tmp_path)
        assert what in error.value.what
