"""What a suite is: objects of each split, how they are rendered, reconstructed and scored, the bars
of its means, its named ablations."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

Bar = tuple[str, float]  # ('>=' or '<=', value)

# Lights of the report split: none of them is a light of the tune split.
REPORT_LIGHTS = tuple(
    f"envmaps/{name}_1k.hdr"
    for name in ("brown_photostudio_02", "noon_grass", "dikhololo_night", "narrow_moonlit_road")
)
REPORT_RELIGHTS = ("envmaps/chinese_garden_1k.hdr", "envmaps/leadenhall_market_1k.hdr")
TUNE_RELIGHTS = ("envmaps/adams_place_bridge_1k.hdr", "envmaps/forest_slope_1k.hdr")


@dataclass(frozen=True)
class Item:
    """One object of a suite. asset: file relative to the data folder, or procedural:SEED[:KIND].
    light: one such file, or several (photos under many lights, ...).
    options: what goes to the synthesizer for this object alone, before the suite's own options.
    flags: as `Suite.flags`, for this object alone."""

    name: str
    asset: str
    light: str | tuple[str, ...]
    options: Mapping[str, Any] = field(default_factory=dict)
    flags: tuple[str, ...] = ()


@dataclass(frozen=True)
class Suite:
    """kind: as `relit reconstruct --capture` knows it. items: of the tune split. relights: lights,
    relative to the data folder, for the truth of relighting. report_items, report_relights: the
    same of the report split (`benchmark.splits`).

    options: keyword arguments of the synthesizer, for all objects.
    synthesize: 'module.function', called as f(asset, light, out, relights=[...], **options,
    say=...) -> capture folder; several lights come as a list.
    settings: 'module.function', called as f(asset, light, relights=[...], **options): everything
    that the capture depends on, whose hash names the folder in the cache; '' for settings_of beside
    `synthesize` in its module.
    evaluate: 'module.function', called as f(run, capture, spp=...) -> {"metrics": {name: {"value",
    "unit", "definition"}}, ...}.
    bars: of the means at quality standard, figure -> bar; draft_bars: at draft.
    flags: words added to every `relit reconstruct` of the suite.
    ablations: name -> words for `relit reconstruct`: each is 'key=value' (a --set) or a flag such
    as '--masks=none'.
    """

    kind: str
    items: tuple[Item, ...]
    relights: tuple[str, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    synthesize: str = "relit.synthesize.multiview.synthesize_multiview"
    evaluate: str = "relit.evaluate.dispatch.evaluate"
    bars: Mapping[str, Bar] = field(default_factory=dict)
    draft_bars: Mapping[str, Bar] = field(default_factory=dict)
    flags: tuple[str, ...] = ()
    ablations: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    report_items: tuple[Item, ...] = ()
    report_relights: tuple[str, ...] = ()
    settings: str = ""

    def bar(self, figure: str, quality: str) -> Bar | None:
        """The bar of a figure at a quality, or None."""
        return {"standard": self.bars, "draft": self.draft_bars}.get(quality, {}).get(figure)

    def items_of(self, split: str) -> tuple[Item, ...]:
        """The objects of a split: 'tune' or 'report'."""
        return self.report_items if split == "report" else self.items

    def relights_of(self, split: str) -> tuple[str, ...]:
        """The lights of the relighting truth of a split."""
        return self.report_relights if split == "report" else self.relights

    def default_split(self) -> str:
        """'tune', or 'report' where the suite has objects of that alone."""
        return "tune" if self.items else "report"

    def settings_function(self) -> Callable[..., dict[str, Any]]:
        """The function that `settings` names."""
        beside = self.synthesize.rpartition(".")[0] + ".settings_of"
        return function_at(self.settings or beside)


def function_at(path: str) -> Callable:
    """The function 'module.function'."""
    module, _, function = path.rpartition(".")
    return getattr(importlib.import_module(module), function)
