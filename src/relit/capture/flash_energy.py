"""Captures whose files tell how bright the flash was for each photo (WildLight): photos without
flash among them, or with another power.

A flash capture is photos under one and the same flash. What was taken without it is left out; the
others are scaled to the strongest flash,
linearly: what is over-exposed in a photo stays so.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from relit.errors import UserError
from relit.scene import Capture, Photo, Pixels

EVEN = 1e-3  # relative spread of the energies below which nothing is scaled
LEAST = 3


@dataclass(frozen=True)
class Scaled:
    """Multiplies the radiance that `load` returns; what was over-exposed stays so
    (`Pixels.white`)."""

    load: Callable[[], Pixels]
    factor: float

    def __call__(self) -> Pixels:
        pixels = self.load()
        return replace(
            pixels,
            rgb=(pixels.rgb * np.float32(self.factor)).astype(np.float32),
            white=pixels.white * self.factor,
        )


def flash_photos(capture: Capture) -> Capture:
    """The capture with those photos alone that the flash lit, as if it had given all of them the
    most that it gave any; with a note of what was done. As it is where the files tell no energies.
    Raises UserError when too few photos are left."""
    if not any(p.flash_energy is not None for p in (*capture.photos, *capture.held_out)):
        return capture
    lit = [p for p in capture.photos if (p.flash_energy or 0) > 0]
    off = len(capture.photos) - len(lit)
    if len(lit) < LEAST:
        raise UserError(
            f"{len(lit)} of {len(capture.photos)} photos were taken with the flash on",
            "the camera file holds the flash's energy for each photo, light_energy_i, and 0 or nothing means off",
            f"take --capture multiview for the photos without flash: {capture.root}",
        )
    notes = (
        [
            f"{off} of {len(capture.photos)} photos were taken without the flash (light_energy 0) and are left out"
        ]
        if off
        else []
    )
    energies = np.array([p.flash_energy for p in lit])
    most = float(energies.max())
    uneven = float(energies.min()) < (1 - EVEN) * most
    if uneven:
        notes.append(
            f"the flash's energy goes from {energies.min():.4g} to {most:.4g}: the photos are scaled to the strongest"
        )

    def even(photos) -> tuple[Photo, ...]:
        kept = [p for p in photos if (p.flash_energy or 0) > 0]
        return tuple(
            replace(p, load=Scaled(p.load, most / p.flash_energy), flash_energy=most)
            if uneven
            else p
            for p in kept
        )

    return replace(
        capture,
        photos=even(capture.photos),
        held_out=even(capture.held_out),
        notes=(*capture.notes, *notes),
    )
