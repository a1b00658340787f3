"""JSON from outside, read field by field with errors that name the place."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any, NoReturn

import torch
from torch import Tensor

from splatart_ns.errors import InputError
from splatart_ns.shape import with_keys_once

LONGEST = 1e18
"""Numbers are below it, so that their squares are float32 numbers."""
_MOST_BYTES = 256 << 20


class Record:
    """A JSON object being read: typed access to its fields, with errors that name the place."""

    def __init__(self, value: Any, path: Path, where: str):
        self.path, self.where = path, where
        if not isinstance(value, dict):
            raise InputError(f"{path}: {where} is {_shown(value)} but must be an object; write the file again")
        self.fields: dict[str, Any] = value

    def fail(self, key: str, found: str, mend: str) -> NoReturn:
        raise InputError(f"{self.path}: '{key}' of {self.where} {found}; {mend}")

    def _get(self, key: str, kind: type | tuple[type, ...], word: str) -> Any:
        if key not in self.fields:
            self.fail(key, "is missing", "write the file again")
        value = self.fields[key]
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            self.fail(key, f"is {_shown(value)}", f"give {word}")
        return value

    def text(self, key: str) -> str:
        value = self._get(key, str, "a text that is not empty")
        if any("\ud800" <= letter <= "\udfff" for letter in value):
            self.fail(key, "holds half a character (a surrogate)", "write it again")
        return value or self.fail(key, "is empty", "give a text that is not empty")

    def integer(self, key: str) -> int:
        return self._get(key, int, "a whole number")

    def flag(self, key: str) -> bool:
        return self._get(key, bool, "true or false")

    def items(self, key: str) -> list:
        return self._get(key, list, "a list")

    def choice(self, key: str, known: list[str]) -> str:
        value = self._get(key, str, "a text")
        return value if value in known else self.fail(key, f"is '{value}'", f"known are {', '.join(known) or 'none'}")

    def record(self, key: str) -> Record:
        return Record(self._get(key, dict, "an object"), self.path, f"'{key}' of {self.where}")

    def records(self, key: str) -> list[Record]:
        named = [(v.get("name") if isinstance(v, dict) else None, v) for v in self.items(key)]
        return [Record(v, self.path, f"{key}[{i}]" + (f" ({n})" if n else "")) for i, (n, v) in enumerate(named)]

    def number(self, key: str) -> float:
        return float(self.numbers(key, self._get(key, (int, float), "a number"), ()))

    def tensor(self, key: str, shape: tuple[int, ...]) -> Tensor:
        return self.numbers(key, self._get(key, list, f"numbers of shape {list(shape)}"), shape)

    def motions(self, key: str, value: Any, count: int) -> Tensor:
        """Rigid motions [count, 4, 4] as float64."""
        T = self.numbers(key, value, (count, 4, 4))
        self._check_rigid(key, T, T[:, :3, :3], "rigid motion")
        return T

    def similarities(self, key: str, count: int) -> Tensor:
        """Rigid motions with a scale [count, 4, 4] as float64."""
        T = self.tensor(key, (count, 4, 4))
        scale = torch.linalg.vector_norm(T[:, :3, :3], dim=1).mean(-1)
        self._check_rigid(key, T, T[:, :3, :3] / scale.clamp_min(1e-12)[:, None, None], "similarity")
        return T

    def _check_rigid(self, key: str, T: Tensor, R: Tensor, kind: str) -> None:
        bottom = torch.tensor([0.0, 0.0, 0.0, 1.0]).to(T)
        orthonormal = torch.allclose(R @ R.mT, torch.eye(3).to(T), atol=1e-5)
        if not orthonormal or not (torch.linalg.det(R) > 0).all() or not (T[:, 3] == bottom).all():
            self.fail(key, f"has a matrix that is no {kind}", "give [R t; 0 0 0 1]")

    def numbers(self, key: str, value: Any, shape: tuple[int, ...], most: float = LONGEST) -> Tensor:
        """Nested lists of exactly this shape, all numbers of a size below `most`, as float64."""

        def check(v: Any, dims: tuple[int, ...]) -> None:
            if dims and isinstance(v, list) and len(v) == dims[0]:
                for item in v:
                    check(item, dims[1:])
            elif dims or isinstance(v, bool) or not isinstance(v, int | float) or not abs(v) < most:
                mend = f"give finite numbers of shape {list(shape)}" if shape else "give a number"
                self.fail(key, f"holds {_shown(v)}", mend)

        check(value, shape)
        return torch.tensor(value, dtype=torch.float64)


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 40 else text[:37] + "..."


def read_record(path: Path, mend: str) -> Record:
    """The JSON object in a file; `mend` says what to do where there is no such file."""

    def refuse(key: str) -> InputError:
        return InputError(f"{path}: an object has the key {_shown(key)} twice; keep one of them")

    if os.path.exists(path) and not os.path.isfile(path):  # a pipe would never end
        raise InputError(f"{path}: is not a file; {mend}")
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise InputError(f"{path}: is larger than {_MOST_BYTES >> 20} MiB; {mend}")
        text = path.read_text(encoding="utf-8-sig")
        value = json.loads(text, parse_constant=_no_constant, object_pairs_hook=with_keys_once(refuse))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); {mend}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not JSON ({error}); write the file again") from error
    return Record(value, path, "the file")


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is no number")
