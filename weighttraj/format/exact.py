"""Python values as JSON values from which the same values are read back.

JSON has no infinite numbers and no tuples. Infinite numbers are written as ``{"$float": "inf"}``
and ``{"$float": "-inf"}``, tuples, where they matter, as ``{"$tuple": [...]}``.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from weighttraj.errors import FormatError

_FLOAT, _TUPLE = "$float", "$tuple"
_INFINITE = {"inf": math.inf, "-inf": -math.inf}
_INTEGERS = range(-(2**63), 2**64)
_SHOWN = 60
"""Characters of a value that an error shows."""


def encode(value: Any, where: str = "") -> Any:
    """Return the JSON value of metadata. Tuples become lists: the fields' types say which is which.

    Args:
        value: plain data, or a data class.
        where: name of the field, for errors.

    Raises:
        FormatError: a value that JSON cannot hold.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {_key(k, where): encode(v, f"{where}.{k}".lstrip(".")) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [encode(item, f"{where}[{i}]") for i, item in enumerate(value)]
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float) and not math.isnan(value):
        return {_FLOAT: str(float(value))} if math.isinf(value) else value
    raise _not_json(value, where)


def encode_exactly(value: Any, where: str) -> Any:
    """Return the JSON value from which ``decode`` makes an equal value of the same types.

    Raises:
        FormatError: there is none, as for functions, arrays, NaN, integers of more than 64 bits.
    """
    kind = type(value)
    if kind is dict:
        keys = {_key(k, where): encode_exactly(v, f"{where}.{k}") for k, v in value.items()}
        if not _is_tag(keys):
            return keys
    elif kind in (list, tuple):
        items = [encode_exactly(item, f"{where}[{i}]") for i, item in enumerate(value)]
        return items if kind is list else {_TUPLE: items}
    elif kind is float:
        return encode(value, where)
    elif (
        value is None
        or kind is bool
        or (kind is int and value in _INTEGERS)
        or (kind is str and _is_unicode(value))
    ):
        return value
    raise _not_json(value, where)


def decode(value: Any) -> Any:
    """Return the value that ``encode`` or ``encode_exactly`` wrote."""
    if isinstance(value, list):
        return [decode(item) for item in value]
    if not isinstance(value, dict):
        return value
    if value.keys() == {_FLOAT} and isinstance(text := value[_FLOAT], str) and text in _INFINITE:
        return _INFINITE[text]
    if value.keys() == {_TUPLE} and isinstance(items := value[_TUPLE], list):
        return tuple(decode(item) for item in items)
    return {key: decode(item) for key, item in value.items()}


def _is_tag(value: dict[str, Any]) -> bool:
    """Return whether ``decode`` would take a dict for something else."""
    return value.keys() <= {_FLOAT, _TUPLE} and len(value) == 1


def _is_unicode(text: str) -> bool:
    try:
        text.encode()
    except UnicodeEncodeError:  # half of a surrogate pair
        return False
    return True


def _key(key: Any, where: str) -> str:
    if type(key) is str and _is_unicode(key):
        return key
    raise _not_json(key, f"a key of {where}")


def _not_json(value: Any, where: str) -> FormatError:
    text = repr(value)
    return FormatError(
        "the metadata holds a value that JSON cannot",
        expected="finite or infinite numbers, strings, booleans, None, lists and dicts of them",
        got=f"{type(value).__name__} {text if len(text) <= _SHOWN else text[:_SHOWN] + '...'}",
        where=where,
        do="describe the value by plain data",
    )
