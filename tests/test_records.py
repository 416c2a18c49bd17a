"""Typed results of stages survive the way through arrays and files."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

import numpy as np
import pytest

from relit.files import load_arrays, save_arrays
from relit.records import from_arrays, to_arrays
from relit.scene import Camera, Mesh


class Status(enum.Enum):
    REGISTERED = "registered"
    LOST = "lost"


@dataclass(frozen=True)
class Placement:
    pose: np.ndarray
    score: float
    status: Status
    note: str | None = None


@dataclass(frozen=True)
class Result:
    placements: tuple[Placement, ...]
    mesh: Mesh
    cameras: list[Camera]
    names: tuple[str, ...]
    span: tuple[int, float]
    mask: np.ndarray | None = None
    shared: bool = False
    empty: tuple[Placement, ...] = field(default=())


def example() -> Result:
    mesh = Mesh(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.int32))
    placements = (
        Placement(np.eye(4), 0.25, Status.REGISTERED),
        Placement(2 * np.eye(4), -1.0, Status.LOST, "behind the others"),
    )
    cameras = [Camera(8, 6, 10.0, 10.0, 4.0, 3.0, np.eye(4))]
    return Result(placements, mesh, cameras, ("a.jpg", "b ü.jpg"), (3, 0.5), shared=True)


def test_a_record_survives_a_file(tmp_path):
    before = example()
    save_arrays(tmp_path / "r.npz", to_arrays(before))
    after = from_arrays(Result, load_arrays(tmp_path / "r.npz"))
    assert after.names == before.names and after.span == before.span and after.shared is True
    assert [p.status for p in after.placements] == [Status.REGISTERED, Status.LOST]
    assert after.placements[0].note is None and after.placements[1].note == "behind the others"
    assert after.mask is None and after.mesh.uvs is None and after.empty == ()
    assert np.array_equal(after.placements[1].pose, 2 * np.eye(4))
    assert after.mesh.faces.dtype == np.int32 and after.cameras[0].fx == 10.0
    assert isinstance(after.cameras, list) and isinstance(after.cameras[0], Camera)


def test_a_missing_field_is_an_error():
    arrays = to_arrays(example())
    del arrays["placements.1.score"]
    with pytest.raises(KeyError):
        from_arrays(Result, arrays)


def test_what_is_no_array_is_refused():
    with pytest.raises(TypeError):
        to_arrays(Placement(np.eye(4), 0.5, Status.LOST, object()))  # type: ignore[arg-type]
