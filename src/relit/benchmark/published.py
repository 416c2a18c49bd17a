"""Values that papers print for the figures of the suites: (value as printed, where)."""

from __future__ import annotations

PUBLISHED: dict[str, dict[str, tuple[str, str]]] = {
    "multiview": {
        "relit_psnr": ("31.84", "PTIR-GS, TensoIR-synthetic"),
    },
    "flash": {
        "novel_psnr": ("31.89", "PIR Tab. 2"),
        "diffuse_psnr": ("35.78", "PIR Tab. 2"),
        "specular_psnr": ("29.72", "PIR Tab. 2"),
        "roughness_mse": (".00088", "PIR Tab. 2"),
    },
    "collection": {
        "novel_psnr": ("23.46", "SAMURAI Tab. 1"),
    },
    "duplicates": {
        "rotation_median": (".19", "SfD Tab. 2, N = 10"),
        "albedo_psnr": ("17.63", "SfD Tab. 1; re-run 17.28"),
        "relit_psnr": ("21.37", "SfD Tab. 1"),
        "roughness_mse": (".062", "SfD Tab. 1; re-run .070"),
        "environment_mse": (".052", "SfD Tab. 1; re-run .137"),
        "chamfer": (".034", "SfD Tab. 1"),
    },
}
