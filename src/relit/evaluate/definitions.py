"""What each figure of `relit evaluate` means: name -> (unit, definition). The sentence is printed
beside the number."""

from __future__ import annotations

from relit.evaluate import metrics as m
from relit.evaluate.environments import ENVIRONMENT_DEFINITIONS
from relit.evaluate.picture_figures import definitions_of

SURFACE_SAMPLES = 100_000  # points per mesh for the Chamfer distance
ROUNDTRIP_VIEWS, ROUNDTRIP_SIDE, ROUNDTRIP_SPP = 3, 400, 64  # pictures, pixels, samples a pixel

SCALE = "one factor per channel on the linear base colour, sum(truth) / sum(predicted) over the object's pixels of a few TRAINING views"
DEFINITIONS: dict[str, tuple[str, str]] = {  # name -> (unit, definition)
    **definitions_of("novel", "test views under the recovered light"),
    **definitions_of(
        "relit",
        f"test views under the unseen lights, mean over lights, base colour scaled ({SCALE})",
    ),
    "relit_psnr_unscaled": (
        "dB",
        "as relit_psnr, without any scale, rendered with a quarter of the samples",
    ),
    "relit_psnr_masked_unscaled": (
        "dB",
        "as relit_psnr_masked, without any scale, rendered with a quarter of the samples",
    ),
    "relit_ssim_unscaled": ("", "as relit_ssim, without any scale, a quarter of the samples"),
    "relit_ssim_masked_unscaled": (
        "",
        "as relit_ssim_masked, without any scale, a quarter of the samples",
    ),
    "albedo_psnr": (
        "dB",
        f"base colour in test views, scaled ({SCALE}), clipped to [0, 1] and sRGB-encoded, over pixels with truth coverage >= {m.MASK}; "
        "a pixel without a prediction counts as black; mean of the per-view PSNR",
    ),
    "albedo_psnr_linear": ("dB", "as albedo_psnr, on linear values"),
    "albedo_psnr_unscaled": ("dB", "as albedo_psnr, without any scale"),
    "normal_mae": ("degrees", f"{m.DEFINITIONS['mae']}; mean over test views"),
    "roughness_mse": (
        "",
        f"perceptual roughness (alpha = r^2) in test views: {m.DEFINITIONS['mse']}",
    ),
    "metallic_mse": ("", f"metallic in test views: {m.DEFINITIONS['mse']}"),
    "mask_iou": (
        "",
        "intersection over union of predicted and true coverage >= .5, mean over test views",
    ),
    "chamfer": (
        "world units",
        f"mean of the two mean distances from samples of one surface to the triangles of the other, {SURFACE_SAMPLES} a mesh, uniform "
        "by area, of which those count that at least one camera (training or test) sees past the mesh itself: hidden inner surfaces do not "
        "count on either side; not squared",
    ),
    "chamfer_percent": (
        "% of diameter",
        "chamfer in per cent of the diameter of the true object's bounding sphere",
    ),
    "chamfer_accuracy": ("world units", "the half of chamfer from the reconstruction to the truth"),
    "chamfer_completeness": (
        "world units",
        "the half of chamfer from the truth to the reconstruction",
    ),
    **ENVIRONMENT_DEFINITIONS,
    "glb_roundtrip_psnr": (
        "dB",
        f"asset read back from object.glb against pictures that the fit rendered of what it held in memory, {ROUNDTRIP_VIEWS} training "
        f"views, recovered light, same random numbers: {m.DEFINITIONS['psnr']}",
    ),
    "glb_roundtrip_psnr_masked": (
        "dB",
        f"as glb_roundtrip_psnr, over pixels with coverage >= {m.MASK} in the pictures of the fit",
    ),
    "glb_roundtrip_ssim": ("", f"as glb_roundtrip_psnr: {m.DEFINITIONS['ssim']}"),
    "cameras": ("%", "share of the training photos that have a camera, where cameras were found"),
    "camera_rotation": (
        "degrees",
        "median rotation error of the recovered cameras after Sim(3) alignment to the true ones "
        "(without those more than 3 medians off)",
    ),
    "camera_centre_percent": (
        "% of diameter",
        "median distance of the recovered camera centres after Sim(3), of the object's diameter",
    ),
}
