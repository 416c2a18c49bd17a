"""What each figure of `relit evaluate` means: name -> (unit, definition). The sentence is printed
beside the number."""

from __future__ import annotations

from relit.evaluate import metrics as m

SURFACE_SAMPLES = 100_000  # points per mesh for the Chamfer distance
ROUNDTRIP_VIEWS, ROUNDTRIP_SIDE, ROUNDTRIP_SPP = 3, 400, 64  # pictures, pixels, samples a pixel

SCALE = "one factor per channel on the linear base colour, sum(truth) / sum(predicted) over the object's pixels of a few TRAINING views"
DEFINITIONS: dict[str, tuple[str, str]] = {  # name -> (unit, definition)
    "novel_psnr": ("dB", f"test views under the recovered light: {m.DEFINITIONS['psnr']}"),
    "novel_psnr_masked": (
        "dB",
        f"test views under the recovered light: {m.DEFINITIONS['psnr_masked']}",
    ),
    "novel_ssim": ("", f"test views under the recovered light: {m.DEFINITIONS['ssim']}"),
    "novel_ssim_masked": (
        "",
        f"test views under the recovered light: {m.DEFINITIONS['ssim_masked']}",
    ),
    "relit_psnr": (
        "dB",
        f"test views under the unseen lights, mean over lights, base colour scaled ({SCALE}): {m.DEFINITIONS['psnr']}",
    ),
    "relit_psnr_masked": ("dB", f"as relit_psnr: {m.DEFINITIONS['psnr_masked']}"),
    "relit_ssim": ("", f"as relit_psnr: {m.DEFINITIONS['ssim']}"),
    "relit_psnr_unscaled": (
        "dB",
        "as relit_psnr, without any scale, rendered with a quarter of the samples",
    ),
    "relit_psnr_masked_unscaled": (
        "dB",
        "as relit_psnr_masked, without any scale, rendered with a quarter of the samples",
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
    "environment_mse": (
        "",
        "recovered against true light, lat-long 256x512, clipped to [0, 1], to the power 1/2.2, mean of all texels (SfD)",
    ),
    "environment_mse_scaled": (
        "",
        "as environment_mse, the recovered light divided by the albedo scale first",
    ),
    "environment_log_rmse": (
        "stops",
        "root mean square difference of log2 radiance by solid angle at 32x64, below 1 % of the mean raised to it, light divided by the "
        "albedo scale first",
    ),
    "glb_roundtrip_psnr": (
        "dB",
        f"asset read back from object.glb against pictures that the fit rendered of what it held in memory, {ROUNDTRIP_VIEWS} training "
        f"views, recovered light, same random numbers: {m.DEFINITIONS['psnr']}",
    ),
    "camera_rotation": (
        "degrees",
        "median rotation error of the recovered cameras after Sim(3) alignment to the true ones",
    ),
    "camera_centre_percent": (
        "% of diameter",
        "median distance of the recovered camera centres after Sim(3), of the object's diameter",
    ),
}
