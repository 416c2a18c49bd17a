"""The papers' own ways to measure, one module each, as their released code does it.

Each has KINDS, the kinds of capture it applies to; MEASURES, what it measures; DEFINITIONS; and
`evaluate_by_protocol(run, folder, draw)`, which returns as `evaluate.dispatch.evaluate`. The figures
are pure functions of arrays; only `*_views` render.
"""
