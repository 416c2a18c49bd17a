"""`relit demo`: render a procedural object, reconstruct it, evaluate it. Nothing is downloaded."""

from __future__ import annotations

import json
from pathlib import Path

from relit.errors import UserError
from relit.files import write_text
from relit.log import Log

VIEWS, TEST_VIEWS, RESOLUTION = 36, 4, 256
SPP, TEST_SPP = 32, 64  # samples per pixel of the photos, and of the test images
SHOWN = (
    "novel_psnr",
    "relit_psnr",
    "albedo_psnr",
    "normal_mae",
    "roughness_mse",
    "chamfer_percent",
    "glb_roundtrip_psnr",
)


def demo(
    out: str | Path, *, device: str = "auto", quality: str = "draft", overwrite: bool = False
) -> Path:
    """Render the pawn of `synthesize.procedural`, reconstruct it, evaluate it and write the report.
    Returns the run folder.

    `out` gets: truth.glb, light.exr, other_light.exr, capture/ (photos and truth), run/ (asset,
    report.html, evaluation.json). The same call again resumes. overwrite: start again.
    """
    from relit.asset.gltf import write_glb
    from relit.device import use_device
    from relit.evaluate.dispatch import evaluate
    from relit.images import write_linear
    from relit.job import Job, open_input
    from relit.reconstruction import reconstruct
    from relit.report.page import write_report
    from relit.synthesize.multiview import synthesize_multiview
    from relit.synthesize.procedural import evening, pawn, studio

    out, log = Path(out), Log()
    if out.exists() and not out.is_dir():
        raise UserError("the output is a file, not a folder", fix=f"give another -o: {out}")
    out.mkdir(parents=True, exist_ok=True)
    use_device(device)
    log.say(f"1 of 4  rendering {VIEWS} photos of the demo object")
    if not (out / "truth.glb").exists():
        write_glb(out / "truth.glb", *pawn())
    for name, light in (("light.exr", studio), ("other_light.exr", evening)):
        if not (out / name).exists():
            write_linear(out / name, light())
    synthesize_multiview(
        out / "truth.glb",
        out / "light.exr",
        out / "capture",
        views=VIEWS,
        test_views=TEST_VIEWS,
        relights=[out / "other_light.exr"],
        resolution=RESOLUTION,
        spp=SPP,
        test_spp=TEST_SPP,
    )
    log.say("2 of 4  reconstructing shape, material and light from the photos")
    run = out / "run"
    reconstruct(
        out / "capture", run, device=device, quality=quality, overwrite=overwrite, report=False
    )
    log.say("3 of 4  evaluating against the ground truth")
    result = evaluate(run, out / "capture", spp=TEST_SPP)
    write_text(run / "evaluation.json", json.dumps(result, indent=1) + "\n")
    log.say("4 of 4  writing the report")
    write_report(run, open_input(out / "capture", Job()))
    for name in SHOWN:
        if name in result["metrics"]:
            entry = result["metrics"][name]
            print(f"{name:20} {entry['value']:8.3f} {entry['unit']}")
    print(f"asset   {run / 'asset' / 'object.glb'}\nreport  {run / 'report.html'}")
    return run
