"""The table of verbs: for each its summary, its flags and the function that runs it."""

from __future__ import annotations

from collections.abc import Sequence

from relit.cli.after import do_export, do_relight, do_view, export_flags, relight_flags, view_flags
from relit.cli.change import do_edit, do_insert, edit_flags, insert_flags
from relit.cli.jobs import (
    demo_flags,
    do_demo,
    do_doctor,
    do_inspect,
    do_quadrants,
    do_reconstruct,
    doctor_flags,
    inspect_flags,
    quadrants_flags,
    reconstruct_flags,
)
from relit.cli.measure import benchmark_flags, do_benchmark, do_evaluate, evaluate_flags
from relit.cli.parser import Parser, Verb
from relit.cli.synthesizers import SYNTHESIZERS, do_synthesize, synthesize_flags
from relit.cli.weights import do_weights, weights_flags

VERBS: dict[str, Verb] = {
    "doctor": Verb(
        "check this machine; print the command that installs what is missing",
        doctor_flags,
        do_doctor,
    ),
    "demo": Verb(
        "render a built-in object, reconstruct it, evaluate it, write the report",
        demo_flags,
        do_demo,
    ),
    "inspect": Verb(
        "check photos, cameras, masks and light before a reconstruction",
        inspect_flags,
        do_inspect,
    ),
    "weights": Verb(
        "fetch the weights of the segmenter, with their licence; nothing else downloads",
        weights_flags,
        do_weights,
    ),
    "quadrants": Verb(
        "enter rough viewpoints of the photos of a collection", quadrants_flags, do_quadrants
    ),
    "reconstruct": Verb(
        "reconstruct an asset from photos; the same command again resumes",
        reconstruct_flags,
        do_reconstruct,
    ),
    "export": Verb(
        "write an asset as glb, obj, ply, Mitsuba scene, HTML page, or its light as Gaussians",
        export_flags,
        do_export,
    ),
    "relight": Verb("render an asset under another light", relight_flags, do_relight),
    "edit": Verb(
        "change the material or remove instances; optionally edit the photo to match",
        edit_flags,
        do_edit,
    ),
    "insert": Verb(
        "insert a model into the photo of a duplicates run, under the recovered light",
        insert_flags,
        do_insert,
    ),
    "view": Verb(
        "open the viewer: object, light, photos next to renders, progress of a run",
        view_flags,
        do_view,
    ),
    "evaluate": Verb(
        "compare a result with ground truth or held-out photos", evaluate_flags, do_evaluate
    ),
    "synthesize": Verb(
        "render a capture with ground truth", synthesize_flags, do_synthesize, SYNTHESIZERS
    ),
    "benchmark": Verb(
        "synthesize, reconstruct and evaluate all objects of a suite", benchmark_flags, do_benchmark
    ),
}

__all__ = ["VERBS", "Parser", "Verb", "parser_for"]


def parser_for(verb: str, argv: Sequence[str] = ()) -> Parser:
    """The parser of one verb. argv: the words after the verb, which select the kind of a verb with
    kinds."""
    spec = VERBS[verb]
    parser = Parser(verb, spec.summary)
    spec.flags(parser)
    if spec.kinds:
        spec.kinds[spec.kind_in(argv)].flags(parser)
    return parser
