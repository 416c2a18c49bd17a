"""The verbs of the command line: one entry each, with its flags and the function that it calls."""

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

VERBS: dict[str, Verb] = {
    "doctor": Verb(
        "what this machine has, what is missing, and the command that mends it",
        doctor_flags,
        do_doctor,
    ),
    "demo": Verb(
        "renders its own object, reconstructs it, scores it, writes the report", demo_flags, do_demo
    ),
    "inspect": Verb(
        "what an input is recognised as, and what a reconstruction would take",
        inspect_flags,
        do_inspect,
    ),
    "quadrants": Verb(
        "asks where each photo of a collection was taken from", quadrants_flags, do_quadrants
    ),
    "reconstruct": Verb(
        "photos into a relightable asset; giving the same command again resumes",
        reconstruct_flags,
        do_reconstruct,
    ),
    "export": Verb(
        "the asset as glb, obj, ply, a Mitsuba scene or a page to send; its light as Gaussians",
        export_flags,
        do_export,
    ),
    "relight": Verb("pictures of the asset under another light", relight_flags, do_relight),
    "edit": Verb(
        "the asset with another material or an instance less, and the photo so changed",
        edit_flags,
        do_edit,
    ),
    "insert": Verb(
        "a model put into the photo of a duplicates run, under the recovered light",
        insert_flags,
        do_insert,
    ),
    "view": Verb(
        "the page: object, light, photos against renders, a run at work", view_flags, do_view
    ),
    "evaluate": Verb(
        "every figure that a known truth allows, with its definition", evaluate_flags, do_evaluate
    ),
    "synthesize": Verb(
        "renders a capture with known truth", synthesize_flags, do_synthesize, SYNTHESIZERS
    ),
    "benchmark": Verb(
        "synthesize, reconstruct and evaluate over a suite", benchmark_flags, do_benchmark
    ),
}

__all__ = ["VERBS", "Parser", "Verb", "parser_for"]


def parser_for(verb: str, argv: Sequence[str] = ()) -> Parser:
    """The parser of one verb. argv: the words after the verb; a verb with kinds takes the flags of
    the kind that they name."""
    spec = VERBS[verb]
    parser = Parser(verb, spec.summary)
    spec.flags(parser)
    if spec.kinds:
        spec.kinds[spec.kind_in(argv)].flags(parser)
    return parser
