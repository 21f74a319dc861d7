"""JSON files of other programs, within bounds, and their values, which may be anything."""

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from deltas_nets.captures.frame import FloatArray
from deltas_nets.captures.json_slips import slip_in_json
from deltas_nets.captures.text_lines import decoded
from deltas_nets.errors import UserError

__all__ = ["Fields", "read_json"]

JSON_LIMIT = 256 * 2**20
"""Bytes. Python takes ten times as much to hold what a file says."""
_LARGE = 2**63
WITHOUT_QUOTES = 'write numbers without quotes: 0.5, not "0.5"'


def read_json(path: Path, *, name: str, remedy: str, limit: int = JSON_LIMIT) -> object:
    """What a JSON file holds.

    Args:
        path: the file.
        name: what it is, for errors, as "transforms".
        remedy: what the user can do.
        limit: bytes that it may have.

    Raises:
        UserError: it cannot be read, is empty, larger, no UTF-8 or no JSON, nested too deeply, or
            names one thing twice.
    """
    try:
        size = path.stat().st_size
        if size > limit:
            what = f"the {name} file has {size / 2**20:.0f} MiB, more than {limit / 2**20:g}"
            raise UserError(what, path, remedy)
        text = decoded(path.read_bytes())
        if not text.strip():
            raise UserError(f"the {name} file is empty", path, remedy)
        return json.loads(text, object_pairs_hook=_once)
    except OSError as error:
        what = f"the {name} file cannot be read ({error.strerror or error})"
        raise UserError(what, path, remedy) from error
    except UnicodeDecodeError as error:
        raise UserError(f"the {name} file is not text in UTF-8", path, remedy) from error
    except json.JSONDecodeError as error:
        slip, cure = slip_in_json(error)
        raise UserError(f"the {name} file is not JSON ({slip})", path, cure or remedy) from error
    except ValueError as error:
        raise UserError(f"the {name} file is not JSON ({error})", path, remedy) from error
    except RecursionError as error:
        raise UserError(f"the {name} file is nested too deeply", path, remedy) from error


def _once(pairs: list[tuple[str, object]]) -> dict[str, object]:
    found = dict(pairs)
    if len(found) < len(pairs):
        twice = next(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
        raise ValueError(f"{twice[:40]!r} is there twice")
    return found


class Fields:
    """The values of a JSON object, each of the type that is asked for.

    Args:
        values: what should be an object.
        path: the file, for errors.
        where: what the object is, for errors, as "frame 3".
        remedy: what the user can do.
        said_by: what else says a value, for errors, by its key.

    Raises:
        UserError: it is no object.
    """

    def __init__(
        self,
        values: object,
        path: Path,
        *,
        where: str,
        remedy: str,
        said_by: Mapping[str, str] | None = None,
    ) -> None:
        self.path, self.where, self.remedy = path, where, remedy
        self._said_by = said_by or {}
        if not isinstance(values, dict):
            raise self.error("is no JSON object")
        self.values: dict[str, object] = values

    @classmethod
    def merged(cls, layers: Sequence["Fields"], keys: Sequence[str]) -> "Fields":
        """The values of some keys, those of later layers before those of earlier ones.

        Errors name the layer that says a value; of one that is missing, the last that says any.
        """
        values: dict[str, object] = {}
        said_by: dict[str, str] = {}
        where = layers[0].where
        for layer in layers:
            found = [key for key in keys if key in layer]
            values |= {key: layer.values[key] for key in found}
            said_by |= dict.fromkeys(found, layer.where)
            where = layer.where if found else where
        last = layers[-1]
        return cls(values, last.path, where=where, remedy=last.remedy, said_by=said_by)

    def error(self, what: str, key: str = "") -> UserError:
        """An error about the object, or about what says the value of a key."""
        return UserError(f"{self.where_of(key)} {what}", self.path, self.remedy)

    def where_of(self, key: str) -> str:
        """What says the value of a key, for errors."""
        return self._said_by.get(key, self.where)

    def __contains__(self, key: str) -> bool:
        return self.values.get(key) is not None

    def inner(self, key: str) -> "Fields":
        """An object inside."""
        return Fields(
            self.values.get(key), self.path, where=f"{key} of {self.where}", remedy=self.remedy
        )

    def items(self, key: str) -> list[object]:
        """A list, whatever is in it; empty where there is none.

        Raises:
            UserError: there is something else.
        """
        found = self.values.get(key, [])
        if not isinstance(found, list):
            raise self.error(f"has no list {key}", key)
        return found

    def text(self, key: str, default: str | None = None) -> str:
        """A text.

        Raises:
            UserError: there is something else, or nothing and no default.
        """
        found = self.values.get(key, default)
        if not isinstance(found, str):
            raise self.error(
                f"has no text {key}" if found is None else f"has a {key} that is no text", key
            )
        return found

    def truth(self, key: str) -> bool:
        """Whether something is true; not where it is not there.

        Raises:
            UserError: there is something else.
        """
        found = self.values.get(key)
        if not isinstance(found, bool | None):
            raise self.error(f"has a {key} that is neither true nor false", key)
        return bool(found)

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number.

        Raises:
            UserError: there is something else, or nothing and no default.
        """
        found = self.values.get(key)
        if default is not None and found is None:
            return default
        # In most cases; the rest need not be quick.
        if type(found) is int and -_LARGE < found < _LARGE:
            return float(found)
        if isinstance(found, float) and math.isfinite(found):
            return found
        return float(self.numbers(key, ())[()])

    def numbers(self, key: str, shape: tuple[int, ...], *, finite: bool = True) -> FloatArray:
        """Numbers in nested lists.

        Args:
            key: their name.
            shape: -1 for any length.
            finite: whether they must be finite.

        Raises:
            UserError: there is something else, or nothing.
        """
        found = self.values.get(key)
        if found is None:
            raise self.error(f"has no {key}")
        array = _array(found, shape)
        if array is None:
            form = " x ".join("any" if size < 0 else str(size) for size in shape)
            wanted = f"{form} numbers" if shape else "a number"
            what = f"{self.where_of(key)} has a {key} that is not {wanted}"
            raise UserError(what, self.path, WITHOUT_QUOTES if _quoted(found) else self.remedy)
        if finite and not np.isfinite(array).all():
            raise self.error(f"has a {key} that is not finite", key)
        return array


def _array(found: object, shape: tuple[int, ...]) -> FloatArray | None:
    if not _all_numbers(found, len(shape)):
        return None
    try:
        array = np.array(found, dtype=np.float64)
    except (ValueError, OverflowError):  # lists of different lengths, whole numbers without end
        return None
    same = array.ndim == len(shape) and all(
        wanted in (-1, size) for wanted, size in zip(shape, array.shape, strict=True)
    )
    return array if same else None


def _all_numbers(found: object, depth: int) -> bool:
    """Whether it is numbers in so many lists; NumPy would take words and truths for numbers."""
    if depth:
        return isinstance(found, list) and all(_all_numbers(item, depth - 1) for item in found)
    return isinstance(found, int | float) and not isinstance(found, bool)


def _quoted(found: object) -> bool:
    """Whether a number stands there as text."""
    if isinstance(found, list):
        return any(map(_quoted, found))
    try:
        return isinstance(found, str) and math.isfinite(float(found))
    except ValueError:
        return False
