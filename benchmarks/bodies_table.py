"""The table of ``bodies.py``: one line for each body, and totals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

LEGEND = """\
Elements are those made and, in brackets, over those requested; volume is the mesh's over the input's. Distances are
mean and 95 % of the mesh's surface from the input's and back, in thousandths of the body's longest side (‰). Pieces are
those of the mesh and of the input: elements that share a face, parts of a surface that touch, or voxels that touch, are
one piece; labels are listed if no element has them. "angle" is the smallest dihedral angle. "s" is processor time from
the file to mesh, surface and these measurements, without loading kernels; the brackets have the wall time on a shared
machine. "said" is whether the command warns: **no** where it should (volume off by more than 3 %, a piece or label lost
or broken off) and does not. "fall" is the largest displacement in 2 s with defaults, over the height. For several
bodies in one file, elements, volumes and pieces are summed, and distances are the largest."""

GOOD_VOLUME, BAD_VOLUME = 0.01, 0.03


@dataclass(frozen=True)
class Row:
    """The results for a body: numbers by name, or the reason why there are none."""

    name: str
    found: dict[str, Any]

    @property
    def is_meshed(self) -> bool:
        return "elements" in self.found

    @property
    def is_silent(self) -> bool:
        """Whether a warning is missing."""
        f = self.found
        warnings = [note for note in f["notes"] if "would help" in note]
        pieces = f["lost_pieces"] > 0 or f["pieces"] > f["input_pieces"] - f["lost_pieces"]
        expected = {"volume": abs(f["volume"] - 1.0) > BAD_VOLUME, "piece": pieces, "label": f["lost_labels"] > 0}
        return any(is_expected and not any(word in line for line in warnings) for word, is_expected in expected.items())

    @property
    def topples(self) -> bool:
        return self.found.get("fall", 0.0) > 1.0 and not self.found.get("free")

    def cells(self) -> list[str]:
        """The columns up to the fall."""
        f = self.found
        if not self.is_meshed:
            if "tets" in f:
                return [self.name, f"tetrahedra already: {f['tets']}", *[""] * 8]
            why = f.get("refused") or f.get("failed") or "?"
            return [self.name, ("refused: " if "refused" in f else "failed: ") + _short(why), *[""] * 8]
        lost = f" ({f['lost_pieces']} lost)" if f["lost_pieces"] else ""
        labels = f", {f['lost_labels']} labels" if f["lost_labels"] else ""
        return [
            self.name,
            f"{f['elements']} ({f['share']:.2f})",
            f"{f['volume']:.3f}",
            " / ".join(f"{1e3 * d:.2g}" for d in f["mean"]),
            " / ".join(f"{1e3 * d:.2g}" for d in f["far"]),
            f"{f['pieces']} of {f['input_pieces']}{lost}{labels}",
            "yes" if f["watertight"] else "**no**",
            f"{f['dihedral']:.0f}°",
            f"{f['cpu_seconds']:.1f} ({f['seconds']:.0f})",
            "**no**" if self.is_silent else "yes" if f["doubts"] else "",
        ]

    def fall(self) -> str:
        """The column of the fall."""
        f = self.found
        if "fall_failed" in f or "fall" not in f:
            return _short(f.get("fall_failed", "")) or ("failed" if self.is_meshed else "")
        text = f"{f['fall']:.2g}" + (", free" if f["free"] else "")
        return f"**{text}**" if self.topples else text


HEAD = ["body", "elements", "volume", "mean ‰", "95 % ‰", "pieces", "watertight", "angle", "s", "said"]


def table(rows: list[Row], before: dict[str, Any] | None = None) -> str:
    """The table in Markdown.

    Args:
        rows: The rows in order.
        before: Numbers of an earlier run by body, whose volumes are shown for comparison.
    """
    fall = any("fall" in row.found for row in rows)
    head = HEAD + (["fall"] if fall else [])
    if before is not None:
        head.insert(3, "before")
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for row in rows:
        cells = row.cells() + ([row.fall()] if fall else [])
        if before is not None:
            volume = before.get(row.name, {}).get("volume")
            cells.insert(3, "" if volume is None else f"{volume:.2g}")
        lines.append("| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |")
    return f"{LEGEND}\n\n" + "\n".join(lines)


def totals(rows: list[Row], tets: int) -> str:
    """Totals in a few lines."""
    made = [row for row in rows if row.is_meshed]
    if not made:
        return f"{len(rows)} bodies, none of them meshed."
    near = sum(abs(row.found["volume"] - 1.0) <= GOOD_VOLUME for row in made)
    budget = sum(0.9 <= row.found["share"] <= 1.0 for row in made)
    whole = sum(row.found["pieces"] == row.found["input_pieces"] for row in made)
    seconds = sorted(row.found["cpu_seconds"] for row in made)
    lines = [
        f"{len(rows)} bodies at {tets} elements; {len(made)} meshed, "
        f"{sum('tets' in row.found for row in rows)} of tetrahedra already, "
        f"{sum('refused' in row.found for row in rows)} refused, {sum('failed' in row.found for row in rows)} failed.",
        f"Volume within 1 %: {near} of {len(made)} ({near / len(made):.0%}). Elements within 10 % below what was asked "
        f"for: {budget}. As many pieces as the input: {whole}. "
        f"Watertight: {sum(row.found['watertight'] for row in made)}. "
        f"Warnings missing: {sum(row.is_silent for row in made)}.",
        f"Processor time: median {seconds[len(seconds) // 2]:.1f} s, longest {seconds[-1]:.1f} s; "
        f"within 4 s: {sum(s <= 4.0 for s in seconds)} of {len(made)}.",
    ]
    # The main thread's time is serial; the other threads share the rest.
    alone = sorted(
        0.5 * (row.found["cpu_seconds"] + row.found.get("own_seconds", row.found["cpu_seconds"])) for row in made
    )
    lines.append(
        f"Wall time on two free cores, by the processor times of threads: median {alone[len(alone) // 2]:.1f} s, "
        f"longest {alone[-1]:.1f} s; within 4 s: {sum(s <= 4.0 for s in alone)} of {len(made)}."
    )
    falls = [row for row in made if "fall" in row.found]
    if falls:
        names = ", ".join(row.name for row in falls if row.topples)
        lines.append(f"Let fall: {len(falls)}; toppled without a word: {names or 'none'}.")
    return "\n".join(lines)


def _short(text: str) -> str:
    text = " ".join(text.split())
    text = text.rpartition("/")[2] if text.startswith("/") else text
    return text if len(text) <= 90 else text[:87] + "..."
