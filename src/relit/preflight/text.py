"""The preflight as text, line by line."""

from __future__ import annotations

from relit.log import readable_bytes, readable_seconds


def rows_of(found: dict) -> list[tuple[str, str]]:
    """(name, value) rows of a result of `inspect_input`."""
    sphere, masks, cost, regime = (
        found["sphere"],
        found["masks"],
        found["estimate"],
        found["light_regime"],
    )
    sizes = ", ".join(f"{w}x{h}" for w, h in found["sizes"][:4]) + (
        " ..." if len(found["sizes"]) > 4 else ""
    )
    ball = (
        "centre {:.4g} {:.4g} {:.4g}, radius {:.4g}".format(*sphere["centre"], sphere["radius"])
        if sphere
        else "unknown"
    )
    forecast = f"{readable_seconds(cost['seconds'])}, {readable_bytes(cost['memory'])} of memory"
    covered = (
        "none"
        if masks is None
        else "cover " + ", ".join(f"{100 * c:.0f} % of {n}" for n, c in list(masks.items())[:4])
    )
    rows = [
        ("input", found["input"]),
        ("recognised as", found["format"]),
        (
            "photos",
            f"{found['photos']} of {sizes} pixels"
            + (f", {found['held_out']} held out" if found["held_out"] else ""),
        ),
        ("cameras", found["cameras"]),
    ]
    if found["epipolar"]:
        e = found["epipolar"]
        near = "" if e["median"] is None else f", median distance {e['median']:.2f} pixels"
        rows.append(
            (
                "epipolar check",
                f"{100 * e['share']:.0f} % of {e['matches']} matches near their epipolar lines{near}",
            )
        )
    rows.append(("object sphere", ball))
    if found["coverage"]:
        c = found["coverage"]
        rows.append(
            (
                "",
                f"fills {100 * c['fill']:.0f} % of the frame; widest gap between views {c['widest_gap']:.0f} degrees",
            )
        )
    drift = found["drift"]
    tints = f"exposure {drift['exposure_spread']:.2f} EV, tint {drift['tint_spread']:.2f}"
    rows += [
        ("masks", covered + (", ..." if masks and len(masks) > 4 else "")),
        ("light regime", f"{regime['guess']} (confidence {100 * regime['confidence']:.0f} %)"),
        ("variation", f"{tints}, {len(drift['blurred'])} blurred"),
        ("capture", f"{found['capture']}: {found['light']}"),
        ("stages", ", ".join(found["stages"])),
        ("estimate", f"{forecast} at quality {cost['quality']} on 2 cores"),
    ]
    return rows


def inspection_text(found: dict) -> str:
    """A result of `inspect_input` as text."""
    lines = [f"{name.ljust(21)}{value}" for name, value in rows_of(found)]
    lines += [f"warning: {w['what']}; {w['fix']}" for w in found["warnings"]]
    return "\n".join(lines + [f"note: {n}" for n in found["notes"]])
