"""Neural-PIL's light network as a prior for the lights of photos, read from a file that the user
has (Boss et al. 2021, used by SAMURAI).

log L_v = log(network(direction, roughness 0, z_v) + ε) + gain_v, with z_v = μ + 3 σ t(noise_v), t a
sigmoid stretched to (-1, 1): SAMURAI's latent code of 128 numbers, inside three deviations of those
that the network was trained with. The network (FiLM-SIREN):

    mapping    z -> 128 -> 128 (ELU) -> phases and frequencies of three layers
    condition  roughness, sin, cos of it and of its double -> 32 (ELU) -> phase and frequency of the
    fourth layer
    main       direction -> sin(frequency (W x + b) + phase), four times -> exp(relu(W x + b)) - 1

Only arrays are read: a pickle, which could run what it likes, never is.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from relit.conventions import environment_directions
from relit.errors import UserError
from relit.lighting.per_photo import COLUMNS, ROWS, TEXELS

WIDTH, DEPTH, CODE = 128, 3, 128
SHAPES = (
    *(
        (3, WIDTH),
        (WIDTH,),
        (WIDTH, WIDTH),
        (WIDTH,),
        (WIDTH, WIDTH),
        (WIDTH,),
        (WIDTH, WIDTH),
        (WIDTH,),
        (WIDTH, 3),
        (3,),
    ),  # main
    *(
        (CODE, WIDTH),
        (WIDTH,),
        (WIDTH, WIDTH),
        (WIDTH,),
        (WIDTH, 2 * DEPTH * WIDTH),
        (2 * DEPTH * WIDTH,),
    ),  # mapping
    *((5, 32), (32,), (32, 2 * WIDTH), (2 * WIDTH,)),  # condition
)
NETWORK, CODES = "network", "latent_mean_std"
PADDING = 1e-3  # by which the sigmoid is stretched
DARK = 1e-2  # ε: radiance that stands for black, so that the logarithm stays


@dataclass(frozen=True)
class NeuralPil:
    """weights: twenty arrays of SHAPES. mean, deviation: (CODE,) of the codes of real lights."""

    weights: tuple[np.ndarray, ...]
    mean: np.ndarray
    deviation: np.ndarray

    @property
    def size(self) -> int:
        """Numbers of a photo."""
        return CODE

    def codes(self, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Latent codes (V, CODE) of noise (V, CODE), and their derivative with respect to it."""
        s = 1 / (1 + np.exp(-np.asarray(noise, np.float32)))
        stretched = 2 * (s * (1 + 2 * PADDING) - PADDING) - 1
        slope = 2 * (1 + 2 * PADDING) * s * (1 - s)
        return self.mean + 3 * self.deviation * stretched, (3 * self.deviation * slope).astype(
            np.float32
        )

    def log_maps(self, noise: np.ndarray) -> np.ndarray:
        """(V, TEXELS * 3) log radiance of the maps, before any gain."""
        return self._run(noise)[0]

    def pull_back(self, noise: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Gradient with respect to noise (V, CODE) of a loss whose gradient with respect to
        `log_maps` is (V, TEXELS * 3)."""
        return self._run(noise, gradient)[1]

    def _run(self, noise, gradient=None):
        w = self.weights
        code, slope = self.codes(noise)
        a0 = code.astype(np.float32) @ w[10] + w[11]
        h0 = _elu(a0)
        a1 = h0 @ w[12] + w[13]
        h1 = _elu(a1)
        film = (h1 @ w[14] + w[15]).reshape(len(code), 2, DEPTH, WIDTH)
        last = self._condition(0.0)
        out = np.empty((len(code), TEXELS * 3), np.float32)
        back = np.empty_like(film) if gradient is not None else None
        directions = _directions()
        for v in range(len(code)):  # a photo at a time: all together would not stay in the cache
            x, kept = directions, []
            for k in range(DEPTH + 1):
                phase, frequency = (film[v, 0, k], film[v, 1, k]) if k < DEPTH else last
                y = x @ w[2 * k] + w[2 * k + 1]
                angle = y * frequency + phase
                kept.append((y, angle, frequency))
                x = np.sin(angle)
            y = x @ w[8] + w[9]
            radiance = np.expm1(np.clip(y, 0, 12))
            out[v] = np.log(radiance + DARK).ravel()
            if gradient is None:
                continue
            g = (
                gradient[v].reshape(TEXELS, 3)
                / (radiance + DARK)
                * np.exp(np.clip(y, 0, 12))
                * ((y > 0) & (y < 12))
            )
            g = g.astype(np.float32) @ w[8].T
            for k in range(DEPTH, -1, -1):
                y, angle, frequency = kept[k]
                g = g * np.cos(angle)
                if k < DEPTH:
                    back[v, 0, k], back[v, 1, k] = g.sum(0), (g * y).sum(0)
                if k > 0:
                    g = (g * frequency) @ w[2 * k].T
        if gradient is None:
            return out, None
        g = back.reshape(len(code), -1) @ w[14].T
        g = (g * _elu_slope(a1)) @ w[12].T
        g = (g * _elu_slope(a0)) @ w[10].T
        return out, g * slope

    def _condition(self, roughness: float) -> tuple[np.ndarray, np.ndarray]:
        """Phase and frequency (WIDTH,) of the layer that the roughness steers."""
        w, r = self.weights, roughness
        waves = [r, np.sin(r), np.sin(2 * r), np.sin(r + np.pi / 2), np.sin(2 * r + np.pi / 2)]
        hidden = _elu(np.array(waves, np.float32) @ w[16] + w[17])
        return tuple((hidden @ w[18] + w[19]).reshape(2, WIDTH))


def load_neural_pil(path: str | Path) -> NeuralPil:
    """The network from a folder (or its file): `*network.npz` with twenty arrays in SAMURAI's order
    (its illumination network) and `*latent_mean_std.npy` (2, 128) beside it. Raises UserError for
    all else, SAMURAI's own pickled network.npy included."""
    path = Path(path).expanduser()
    if not path.exists():
        raise UserError("the light network is not there", fix=f"check the path: {path}")
    folder = path if path.is_dir() else path.parent
    files = (
        [path]
        if path.is_file()
        else sorted(f for f in folder.glob(f"*{NETWORK}.npz") if not f.name.startswith("brdf"))
    )
    if not files:
        pickled = any(f.name.endswith(f"{NETWORK}.npy") for f in folder.glob("*.npy"))
        hint = (
            "it holds a pickled network.npy, which is not read, because a pickle may run any code; "
            if pickled
            else ""
        )
        fix = f"convert it once, on a machine of yours, to network.npz with twenty arrays in the order of SAMURAI's file: {folder}"
        raise UserError("no Neural-PIL network was found", f"{hint}looked for *{NETWORK}.npz", fix)
    weights = _arrays(files[0])
    shapes = tuple(a.shape for a in weights)
    if shapes != SHAPES:
        wrong = next(
            (i for i, (a, b) in enumerate(zip(shapes, SHAPES, strict=False)) if a != b),
            min(len(shapes), len(SHAPES)),
        )
        found = shapes[wrong] if wrong < len(shapes) else "nothing"
        what = (
            f"array {wrong} is {found}, {SHAPES[wrong]} is expected"
            if wrong < len(SHAPES)
            else f"{len(shapes)} arrays, 20 are expected"
        )
        raise UserError(
            "this is not Neural-PIL's light network",
            what,
            f"give the one that SAMURAI comes with: {files[0]}",
        )
    codes = sorted(folder.glob(f"*{CODES}.npy"))
    if not codes:
        raise UserError(
            "the codes' mean and deviation are missing",
            f"looked for *{CODES}.npy beside the network",
            f"add it: {folder}",
        )
    try:
        numbers = np.load(codes[0], allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        fix = f"give a plain array (2, 128): {codes[0]}"
        raise UserError(
            "the codes' mean and deviation could not be read", str(error)[:200], fix
        ) from error
    if numbers.shape != (2, CODE) or not np.isfinite(numbers).all():
        raise UserError(
            f"the codes' mean and deviation are {numbers.shape}, not (2, 128)",
            fix=f"give SAMURAI's file: {codes[0]}",
        )
    return NeuralPil(weights, numbers[0].astype(np.float32), np.abs(numbers[1]).astype(np.float32))


def _arrays(file: Path) -> tuple[np.ndarray, ...]:
    """The arrays of an .npz in the order of the numbers in their names (numpy's own, arr_0 to
    arr_19, are not padded). Raises UserError where it cannot be read as plain numbers."""
    try:
        with np.load(file, allow_pickle=False) as data:
            if not hasattr(data, "files"):
                raise ValueError("a single array")
            arrays = [np.asarray(data[n]) for n in sorted(data.files, key=_with_numbers)]
    except (ValueError, OSError, EOFError, KeyError) as error:
        fix = f"give an .npz of plain arrays (a pickled one is never read): {file}"
        raise UserError("the light network could not be read", str(error)[:200], fix) from error
    if not all(a.dtype.kind == "f" and np.isfinite(a).all() for a in arrays):
        raise UserError(
            "the light network holds something other than finite numbers",
            fix=f"fetch it again: {file}",
        )
    return tuple(a.astype(np.float32) for a in arrays)


def _with_numbers(name: str) -> list:
    """What sorts names by the numbers in them: text and numbers in turn."""
    return [int(part) if part.isdigit() else part for part in re.split(r"([0-9]+)", name)]


def _directions() -> np.ndarray:
    """(TEXELS, 3) in the network's axes, +y up as ours; which way it faces does not matter, since
    every turn was seen in training."""
    return environment_directions(ROWS, COLUMNS).reshape(TEXELS, 3).astype(np.float32)


def _elu(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, np.expm1(np.minimum(x, 0)))


def _elu_slope(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, 1, np.exp(np.minimum(x, 0))).astype(np.float32)
