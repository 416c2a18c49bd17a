"""Neural-PIL files with random weights."""

import numpy as np

from relit.lighting.neural_pil import CODE, SHAPES


def write_network(folder, shapes=SHAPES, seed=0):
    rng = np.random.default_rng(seed)
    arrays = {
        f"w{i:02d}": (rng.normal(size=s) / np.sqrt(s[0])).astype(np.float32)
        for i, s in enumerate(shapes)
    }
    arrays["w09"] = np.ones(3, np.float32)
    np.savez(folder / "illumination-network_network.npz", **arrays)
    np.save(
        folder / "illumination_latent_mean_std.npy",
        np.stack([np.zeros(CODE), np.ones(CODE)]).astype(np.float32),
    )
