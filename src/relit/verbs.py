"""The verbs of the command line: their flags, and the function that each calls. Heavy imports stand inside the functions."""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from relit.errors import EXIT_USAGE, UserError, did_you_mean

QUALITIES = ("draft", "standard", "high")
DEVICES = ("auto", "cpu", "cuda")
KINDS = ("multiview", "flash", "duplicates", "collection")


@dataclass(frozen=True)
class Verb:
    """summary: one line for the overview. flags: adds arguments to a parser (common ones to the first group). act: does it."""

    summary: str
    flags: Callable[[Parser], None]
    act: Callable[[argparse.Namespace], int | None]


class Parser(argparse.ArgumentParser):
    """argparse whose complaints are UserErrors with a suggestion; `common` and `more` are the two groups of the help."""

    def __init__(self, verb: str, summary: str):
        super().__init__(prog=f"relit {verb}", description=summary, allow_abbrev=False)
        self.verb = verb
        self.common = self.add_argument_group("common flags")
        self.more = self.add_argument_group("more flags")

    def parse(self, argv: list[str]) -> argparse.Namespace | None:
        """Parsed arguments, or None when --help was asked and answered."""
        if "-h" in argv or "--help" in argv:
            self.print_help()
            return None
        argv = self._joined(argv)
        known = {o for a in self._actions for o in a.option_strings}
        for word in argv:
            if word.startswith("--") and word.split("=")[0] not in known:
                self._refuse(word)
        args, left = self.parse_known_args(argv)
        if left:
            self._refuse(left[0])
        return args

    def _joined(self, argv: list[str]) -> list[str]:
        """A value that begins with a minus and a digit is joined to its flag: argparse would take it for a flag."""
        taking = {o for a in self._actions for o in a.option_strings if o.startswith("--") and a.nargs is None}
        out: list[str] = []
        for word in argv:
            if out and out[-1] in taking and re.match(r"-[\d.]", word):
                out[-1] += f"={word}"
            else:
                out.append(word)
        return out

    def error(self, message: str):
        missing = re.match(r"the following arguments are required: (.*)", message)
        what = f"missing: {missing.group(1)}" if missing else message
        raise UserError(f"relit {self.verb}: {what}", fix=f"relit {self.verb} --help", code=EXIT_USAGE)

    def _check_value(self, action, value) -> None:
        if action.choices is not None and value not in action.choices:
            name = action.option_strings[-1] if action.option_strings else action.dest
            what = f"relit {self.verb}: {name} {value} is not known.{did_you_mean(str(value), action.choices)}"
            raise UserError(what, f"one of: {', '.join(action.choices)}", code=EXIT_USAGE)

    def _refuse(self, word: str):
        flag = word.split("=")[0]
        flags = [o for a in self._actions for o in a.option_strings if o.startswith("--")]
        if word.startswith("-"):
            what = f"relit {self.verb}: unknown flag '{flag}'.{did_you_mean(flag, flags)}"
        else:
            what = f"relit {self.verb}: unexpected '{word}'; there is one input"
        raise UserError(what, fix=f"relit {self.verb} --help", code=EXIT_USAGE)


def parser_for(verb: str) -> Parser:
    """The parser of one verb."""
    parser = Parser(verb, VERBS[verb].summary)
    VERBS[verb].flags(parser)
    return parser


def _path_in(parser: Parser, name: str, text: str) -> None:
    parser.add_argument(name, type=Path, help=text)


def _out(parser: Parser, text: str, default: Path | None = None) -> None:
    parser.common.add_argument("-o", "--out", type=Path, required=default is None, default=default, metavar="PATH", help=text)


def _job(parser: Parser, quality: str | None) -> None:
    add = parser.common.add_argument
    add("--quality", choices=QUALITIES, default=quality, help="draft (about a minute), standard (default) or high")
    add("--device", choices=DEVICES, default="auto", help="auto takes the GPU when there is one")
    add("--seed", type=int, default=None, help="same seed, same result within tolerance on the CPU (default 0)")


def _opening(parser: Parser) -> None:
    """Flags that say how the input is to be read."""
    add = parser.more.add_argument
    add("--masks", default=None, metavar="HOW", help="auto (default), none, alpha, files, threshold, grabcut, segment")
    add("--sphere", type=_sphere, default=None, metavar="X,Y,Z,R", help="ball that holds the object, in the frame and unit of the cameras")
    add("--max-side", type=int, default=None, metavar="PIXELS", help="shrink photos whose longer side is longer")


def _sphere(text: str) -> tuple[float, ...]:
    parts = text.split(",")
    try:
        values = tuple(float(p) for p in parts)
    except ValueError:
        values = ()
    if len(values) != 4 or not values[3] > 0:
        raise argparse.ArgumentTypeError(f"'{text}' is not X,Y,Z,RADIUS")
    return values


# ---------------------------------------------------------------- doctor, demo, inspect


def _doctor_flags(parser: Parser) -> None:
    parser.common.add_argument("--json", action="store_true", help="print JSON")


def _doctor(args) -> int:
    from relit import doctor

    checks = doctor.examine()
    print(doctor.as_json(checks) if args.json else doctor.as_text(checks))
    return doctor.verdict(checks)


def _demo_flags(parser: Parser) -> None:
    _out(parser, "folder for the capture and the run (default runs/demo)", Path("runs/demo"))
    parser.common.add_argument("--device", choices=DEVICES, default="auto", help="auto takes the GPU when there is one")
    parser.common.add_argument("--overwrite", action="store_true", help="begin anew where an earlier demo is complete or was stopped")


def _demo(args) -> None:
    from relit.demo import demo

    demo(args.out, device=args.device, overwrite=args.overwrite)


def _inspect_flags(parser: Parser) -> None:
    _path_in(parser, "input", "folder of photos, transforms.json, COLMAP model, ...")
    parser.common.add_argument("--json", action="store_true", help="print JSON")
    parser.common.add_argument("--quality", choices=QUALITIES, default="standard", help="for the estimate of time and memory")
    parser.common.add_argument("--plot", type=Path, default=None, metavar="FILE.svg", help="draw the cameras around the object sphere")
    _opening(parser)


def _inspect(args) -> None:
    from relit.plan import Job
    from relit.preflight import as_text, inspect

    if args.plot is not None:
        _free(args.plot, overwrite=False)
    job = Job(quality=args.quality, masks=args.masks or "auto", sphere=args.sphere, max_side=args.max_side)
    found = inspect(args.input, job, args.plot)
    print(json.dumps(found, indent=2) if args.json else as_text(found))


# ---------------------------------------------------------------- reconstruct


def _reconstruct_flags(parser: Parser) -> None:
    _path_in(parser, "input", "folder of photos, transforms.json, COLMAP model, ... (docs/formats.md)")
    _out(parser, "run folder; giving the same command again resumes")
    add = parser.common.add_argument
    add("--capture", choices=("auto", *KINDS), default=None, help="what kind of photos (default auto)")
    _job(parser, None)
    add("--set", action="append", default=[], metavar="KEY=VALUE", dest="pairs", help="one setting of the recipe; may be repeated")
    add("--config", type=Path, default=None, metavar="FILE.toml", help="settings from a file, a run's config.toml too; flags win")
    _opening(parser)
    parser.more.add_argument("--focal", type=float, default=None, metavar="PIXELS", help="known focal length, for photos without cameras")
    parser.more.add_argument("--overwrite", action="store_true", help="remove what an earlier run left in the folder and begin anew")


def _reconstruct(args) -> None:
    from relit.reconstruct import reconstruct

    asset = reconstruct(
        args.input,
        args.out,
        capture=args.capture,
        quality=args.quality,
        device=args.device,
        seed=args.seed,
        pairs=args.pairs,
        config=args.config,
        masks=args.masks,
        sphere=args.sphere,
        max_side=args.max_side,
        focal=args.focal,
        overwrite=args.overwrite,
    )
    print(asset / "object.glb")


# ---------------------------------------------------------------- after the reconstruction


def _export_flags(parser: Parser) -> None:
    _path_in(parser, "run", "run folder or asset folder")
    _out(parser, "file (or folder, for mitsuba) to write")
    parser.common.add_argument("--format", choices=("glb", "obj", "ply", "mitsuba"), default=None, help="default: by the ending of -o")
    parser.more.add_argument("--overwrite", action="store_true", help="replace an existing file")


def _export(args) -> None:
    kind = args.format or {".glb": "glb", ".obj": "obj", ".ply": "ply"}.get(args.out.suffix.lower())
    if kind is None:
        raise UserError("the form cannot be told from the ending of -o", fix="add --format glb, obj, ply or mitsuba", code=EXIT_USAGE)
    _free(args.out, args.overwrite)
    from relit.asset.export import export_asset

    export_asset(args.run, kind, args.out)
    print(args.out)


def _relight_flags(parser: Parser) -> None:
    _path_in(parser, "run", "run folder or asset folder")
    parser.common.add_argument("--light", required=True, type=Path, metavar="FILE", help="lat-long .hdr or .exr")
    _out(parser, "folder of pictures, or FILE.mp4")
    add = parser.common.add_argument
    add("--cameras", default="capture", metavar="WHICH", help="capture (default), orbit:N for a turntable, or a transforms.json")
    add("--device", choices=DEVICES, default="auto", help="auto takes the GPU when there is one")
    more = parser.more.add_argument
    more("--spp", type=int, default=64, help="samples a pixel (default 64)")
    more("--size", type=int, default=None, metavar="PIXELS", help="longer side of the pictures")
    more("--rotate", type=float, default=0.0, metavar="DEGREES", help="turn the light about the object's up")
    more("--exr", action="store_true", help="linear EXR pictures besides the PNG ones")
    more("--overwrite", action="store_true", help="replace existing pictures")


def _relight(args) -> None:
    _free(args.out, args.overwrite)
    from relit.device import use_device
    from relit.log import Log, Progress

    use_device(args.device)
    from relit.relight import relight

    progress = Progress(Log(), "relight", None)

    def show(done: int, count: int) -> None:
        progress.steps = count
        progress.update(done)

    options = {"cameras": args.cameras, "spp": args.spp, "size": args.size, "exr": args.exr, "rotate": args.rotate}
    relight(args.run, args.light, args.out, progress=show, **options)
    progress.log.clear()
    print(args.out)


def _evaluate_flags(parser: Parser) -> None:
    _path_in(parser, "run", "run folder or asset folder")
    parser.common.add_argument("--truth", required=True, type=Path, metavar="DIR", help="folder that relit synthesize wrote")
    parser.common.add_argument("--json", type=Path, default=None, metavar="FILE", help="write the figures there")
    parser.common.add_argument("--device", choices=DEVICES, default="auto", help="auto takes the GPU when there is one")
    parser.more.add_argument("--spp", type=int, default=128, help="samples a pixel of the compared pictures (default 128)")


def _evaluate(args) -> None:
    from relit.device import use_device
    from relit.evaluate.protocols import evaluate, table
    from relit.files import write_text

    use_device(args.device)
    result = evaluate(args.run, args.truth, spp=args.spp)
    if args.json:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        write_text(args.json, json.dumps(result, indent=1) + "\n")
    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else 160).print(table(result))


def _synthesize_flags(parser: Parser) -> None:
    parser.add_argument("kind", choices=KINDS, help="kind of capture")
    add = parser.common.add_argument
    add("--asset", required=True, type=Path, metavar="FILE", help=".glb, .gltf or .obj")
    add("--light", required=True, type=Path, nargs="+", metavar="FILE", help="lat-long .hdr or .exr")
    _out(parser, "folder to write")
    add("--relight", type=Path, nargs="*", default=[], metavar="FILE", help="other lights, for the truth of relighting")
    add("--views", type=int, default=60, help="training photos (default 60)")
    add("--test-views", type=int, default=12, help="test photos (default 12)")
    add("--device", choices=DEVICES, default="auto", help="auto takes the GPU when there is one")
    more = parser.more.add_argument
    more("--resolution", type=int, default=400, help="pixels a side (default 400)")
    more("--spp", type=int, default=64, help="samples a pixel of training photos (default 64)")
    more("--test-spp", type=int, default=256, help="samples a pixel of what is measured against (default 256)")
    more("--seed", type=int, default=0, help="default 0")
    more("--roughness", type=float, default=None, help="constant instead of the file's map")
    more("--metallic", type=float, default=None, help="constant instead of the file's map")


def _synthesize(args) -> None:
    if args.kind != "multiview":
        what = f"synthesize {args.kind} is not available in this version"
        raise UserError(what, "only multiview captures are rendered so far", code=EXIT_USAGE)
    if len(args.light) != 1:
        raise UserError("a multiview capture has one light", fix="give one file to --light; others go to --relight", code=EXIT_USAGE)
    from relit.capture.synthetic import synthesize_multiview
    from relit.device import use_device
    from relit.log import Log

    use_device(args.device)
    synthesize_multiview(
        args.asset,
        args.light[0],
        args.out,
        views=args.views,
        test_views=args.test_views,
        relights=args.relight,
        resolution=args.resolution,
        spp=args.spp,
        test_spp=args.test_spp,
        seed=args.seed,
        roughness=args.roughness,
        metallic=args.metallic,
        say=Log().say,
    )
    print(args.out)


def _benchmark_flags(parser: Parser) -> None:
    parser.add_argument("suite", help="name of a suite: multiview")
    _job(parser, "standard")
    add = parser.common.add_argument
    add("--json", type=Path, default=None, metavar="FILE", help="write the figures there")
    add("--ablate", default="", metavar="NAME,...", help="also run with these parts switched off")
    more = parser.more.add_argument
    more("--objects", default="", metavar="NAME,...", help="only these objects of the suite")
    more("--cache", type=Path, default=None, metavar="DIR", help="where rendered captures are kept")
    more("--assets", type=Path, default=None, metavar="DIR", help="folder with assets/ and envmaps/")
    more("-o", "--out", type=Path, default=None, metavar="DIR", help="where the runs go")


def _benchmark(args) -> None:
    from relit.benchmark import run_suite

    run_suite(
        args.suite,
        quality=args.quality,
        ablate=[a for a in args.ablate.split(",") if a],
        json_file=args.json,
        device=args.device,
        cache=args.cache,
        assets=args.assets,
        objects=[o for o in args.objects.split(",") if o],
        out=args.out,
        seed=args.seed or 0,
    )


def _free(path: Path, overwrite: bool) -> None:
    """Nothing is overwritten silently: refuse an existing file or a folder with something in it."""
    taken = path.is_file() or (path.is_dir() and any(path.iterdir()))
    if taken and not overwrite:
        raise UserError("the output is there already; nothing was overwritten", fix=f"give another -o, or --overwrite: {path}")
    path.parent.mkdir(parents=True, exist_ok=True)


VERBS: dict[str, Verb] = {
    "doctor": Verb("what this machine has, what is missing, and the command that mends it", _doctor_flags, _doctor),
    "demo": Verb("renders its own object, reconstructs it, scores it, writes the report", _demo_flags, _demo),
    "inspect": Verb("what an input is recognised as, and what a reconstruction would take", _inspect_flags, _inspect),
    "reconstruct": Verb("photos into a relightable asset; giving the same command again resumes", _reconstruct_flags, _reconstruct),
    "export": Verb("the asset as glb, obj, ply or a Mitsuba scene", _export_flags, _export),
    "relight": Verb("pictures of the asset under another light", _relight_flags, _relight),
    "evaluate": Verb("every figure that a known truth allows, with its definition", _evaluate_flags, _evaluate),
    "synthesize": Verb("renders a capture with known truth", _synthesize_flags, _synthesize),
    "benchmark": Verb("synthesize, reconstruct and evaluate over a suite", _benchmark_flags, _benchmark),
}
