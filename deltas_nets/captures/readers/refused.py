"""What is no capture yet, recognised by name, and which program makes one of it."""

from collections.abc import Callable, Sequence
from itertools import islice
from pathlib import Path
from shlex import quote

from deltas_nets.captures.readers.names import IMAGE_SUFFIXES
from deltas_nets.errors import UserError

__all__ = ["refusal"]

_COLMAP = (
    "colmap automatic_reconstructor --dense 0 --workspace_path {folder} --image_path {images} "
    "finds the poses; then name {folder}"
)
_LOOKED_AT = 10_000
"""Entries of a folder."""

Rule = tuple[str, Callable[[Path, bytes], bool], str]

_MODELS: tuple[Rule, ...] = (
    (
        "a VisualSFM model",
        lambda path, head: path.suffix.lower() == ".nvm" or head.startswith(b"NVM_V"),
        "it has no principal points and one distortion of its own: run COLMAP on its photos, "
        + _COLMAP,
    ),
    (
        "a Meshroom scene",
        lambda path, head: path.suffix.lower() in (".mg", ".sfm", ".baf", ".abc"),
        "export it as COLMAP (aliceVision_exportColmap), or run COLMAP on its photos: " + _COLMAP,
    ),
    (
        "a Metashape project",
        lambda path, head: (
            path.suffix.lower() in (".psx", ".psz")
            or (path.suffix.lower() == ".xml" and b"<document" in head and b"<chunk" in head)
        ),
        "in Metashape choose File > Export > Export Cameras > COLMAP, and name what it writes",
    ),
    (
        "a RealityCapture export",
        lambda path, head: (
            path.suffix.lower() in (".rcproj", ".rsproj")
            or (path.suffix.lower() == ".csv" and head.lower().startswith((b"#name,", b"name,x,y")))
        ),
        "in RealityCapture export the registration as COLMAP text, and name the folder it writes",
    ),
    (
        "a binary scene of OpenMVG",
        lambda path, head: path.name.startswith("sfm_data") and path.suffix == ".bin",
        "write it as text: openMVG_main_ConvertSfM_DataFormat -i sfm_data.bin -o sfm_data.json",
    ),
    (
        "a Bundler model",
        lambda path, head: path.suffix.lower() == ".out" and head.startswith(b"# Bundle file"),
        "it has no principal points and no sizes: run COLMAP on its photos, " + _COLMAP,
    ),
)
"""What it is called, how it is known by name and first bytes, and the way to go."""

_RECORDINGS: tuple[Rule, ...] = (
    (
        "a Record3D recording",
        lambda path, head: path.suffix.lower() == ".r3d",
        "in Record3D export it as EXR and JPEG sequence, and name the folder it writes",
    ),
    (
        "a video",
        lambda path, head: path.suffix.lower() in (".mp4", ".mov", ".avi", ".mkv", ".webm"),
        "make photos of it (ffmpeg -i VIDEO -r 3 -q:v 2 images/%05d.jpg) and run COLMAP: "
        + _COLMAP,
    ),
    (
        "an archive",
        lambda path, head: path.suffix.lower() in (".zip", ".tar", ".gz", ".7z"),
        "unpack it, and name the folder",
    ),
)
"""The same of what is no capture only where nothing else is there."""

_TEXTS = (".nvm", ".xml", ".csv", ".out")
"""Suffixes of files that only their first bytes tell apart."""


def refusal(path: Path) -> UserError | None:
    """Why a folder or file that no reader recognises is refused, if it is known what it is.

    Example:
        >>> print(refusal(Path("walk.mp4")).what)
        this is a video, not a capture
    """
    files = _entries(path) if path.is_dir() else [path]
    return _known(files, _MODELS, path) or _photos(path, files) or _known(files, _RECORDINGS, path)


def _known(files: Sequence[Path], rules: Sequence[Rule], path: Path) -> UserError | None:
    for file in files:
        head = _head(file)
        for called, known, remedy in rules:
            if known(file, head):
                return UserError(f"this is {called}, not a capture", file, _filled(remedy, path))
    return None


def _photos(path: Path, entries: Sequence[Path]) -> UserError | None:
    if not path.is_dir():
        return None
    for folder in (path, *(entry for entry in entries if entry.is_dir())):
        inside = entries if folder == path else _entries(folder)
        photos = sum(each.suffix.lower() in IMAGE_SUFFIXES and each.is_file() for each in inside)
        if photos > 1:
            what = f"the folder holds {photos} photos without poses"
            return UserError(what, folder, _filled(_COLMAP, path, folder))
    return None


def _entries(folder: Path) -> list[Path]:
    return sorted(islice(folder.iterdir(), _LOOKED_AT))


def _head(path: Path) -> bytes:
    try:
        if path.suffix.lower() not in _TEXTS or not path.is_file():
            return b""
        with path.open("rb") as file:
            return file.read(4096)
    except OSError:
        return b""


def _filled(remedy: str, path: Path, photos: Path | None = None) -> str:
    folder = path if path.is_dir() else path.parent
    if photos is None:
        photos = folder / "images" if (folder / "images").is_dir() else folder
    return remedy.replace("{folder}", quote(str(folder))).replace("{images}", quote(str(photos)))
