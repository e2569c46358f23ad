"""The plan: what will be computed, what is left out and why, before any heavy work."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field


@dataclass(frozen=True)
class LeftOut:
    """Something this scene does not need.

    Attributes:
        what: the work left out. why: the reason. saving: how much, in words or numbers. error: what it costs in
            accuracy; "none" where the result is the same.
    """

    what: str
    why: str
    saving: str
    error: str = "none"


@dataclass(frozen=True)
class Plan:
    """A readable plan, the same in the command line, the panel and the report.

    Attributes:
        steps: stage -> what it will do.
        left_out: one entry for each thing not done.
        slices: indices of the slices that will be coloured (counted in the order of `order`).
        features, device, smoother: as resolved.
        warnings: what may go wrong, with the remedy, one sentence each.
    """

    steps: dict[str, str]
    left_out: list[LeftOut] = field(default_factory=list)
    slices: tuple[int, ...] = ()
    features: str = ""
    device: str = ""
    smoother: str = ""
    warnings: tuple[str, ...] = ()

    def text(self) -> str:
        """For people: one line a step, one line a thing left out."""
        lines = ["Plan"] + [f"  {name:<14} {what}" for name, what in self.steps.items()]
        lines += [f"Warning: {text}" for text in self.warnings]
        lines.append("Left out")
        for entry in self.left_out:
            error = "" if entry.error == "none" else f" (error: {entry.error})"
            lines.append(f"  - {entry.what}: {entry.why}; saves {entry.saving}{error}")
        return "\n".join(lines)

    def to_dict(self) -> dict:
        """Plain data, JSON-ready."""
        return asdict(self)
