"""Run-length masks as COCO and MVMC (the cars of NeRS) write them: background and object in turns,
down the columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from relit.errors import UserError

MOST_PIXELS = 2**28  # of a mask; more is no photo


@dataclass(frozen=True)
class Runs:
    """counts: lengths of runs down the columns, the first of background. size: (height, width).
    name: in errors."""

    counts: tuple[int, ...]
    size: tuple[int, int]
    name: str

    def decode(self) -> np.ndarray:
        """(H, W) float32, 0 or 1."""
        h, w = self.size
        values = np.arange(len(self.counts)) % 2
        return np.repeat(values, self.counts).astype(np.float32).reshape(w, h).T


def runs_from(content, name: str) -> Runs:
    """{"counts": list, "59 391 ..." or COCO's packed text, "size": [h, w]} -> Runs. Raises
    UserError for all else."""
    size = content.get("size") if isinstance(content, dict) else None
    counts = content.get("counts") if isinstance(content, dict) else None
    ok = (
        isinstance(size, list)
        and len(size) == 2
        and all(type(v) is int and v > 0 for v in size)
        and size[0] * size[1] <= MOST_PIXELS
    )
    if not ok or not isinstance(counts, (list, str)):
        raise UserError(
            f"the mask of '{name}' is no run-length mask",
            "it needs counts and size [height, width]",
            "write the file again",
        )
    if isinstance(counts, str):
        try:
            words = counts.split()
            plain = all(v.isascii() and v.isdigit() for v in words) and (
                len(words) != 1 or int(words[0]) == size[0] * size[1]
            )
            counts = [int(v) for v in words] if plain else _unpacked(counts)
        except (ValueError, IndexError) as error:
            raise UserError(
                f"the runs of the mask of '{name}' cannot be read",
                str(error)[:100],
                "write the file again",
            ) from error
    if not all(type(v) is int and v >= 0 for v in counts) or sum(counts) != size[0] * size[1]:
        what = f"the runs of the mask of '{name}' do not add up to {size[0]} x {size[1]} pixels"
        raise UserError(
            what, "the file is damaged, or the size is another photo's", "write the file again"
        )
    return Runs(tuple(counts), (size[0], size[1]), name)


def _unpacked(text: str) -> list[int]:
    """COCO's packed counts: six bits a letter, five of them of the number, from the third number on
    as differences to two before."""
    out: list[int] = []
    at = 0
    while at < len(text):
        value, shift = 0, 0
        while True:
            letter = ord(text[at]) - 48
            if not 0 <= letter < 64:
                raise ValueError(f"'{text[at]}' is no letter of packed runs")
            value |= (letter & 31) << shift
            shift, at = shift + 5, at + 1
            if not letter & 32:
                break
        if letter & 16:
            value -= 1 << shift
        out.append(value + (out[-2] if len(out) > 2 else 0))
    return out
