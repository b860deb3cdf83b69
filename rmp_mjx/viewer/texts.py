"""What the tree thinks in words and bars: small pieces of HTML."""

from __future__ import annotations

import numpy as np

from rmp_mjx.viewer.drawing import COLORS, OTHER
from rmp_mjx.viewer.insight import Insight
from rmp_mjx.viewer.session import Frame

_DECADES = (-2.0, 3.0)
"""Powers of ten of the shortest and the longest bar of what is asked."""


def bars(insight: Insight, watched: str) -> str:
    """A bar for each branch: as long as what it asks, full where it gets its way.

    Args:
        insight: What the tree thinks.
        watched: Who drives the arm.
    """
    lines = [
        "<div style='font-size:12px;padding:0 10px'>"
        f"<p>What each leaf asks (length, by decades) and gets of <b>{watched}</b> "
        "(full part).</p>"
    ]
    for name, asked in insight.asked.items():
        got = obeyed(float(asked), float(insight.missed[name]))
        low, high = _DECADES
        decades = np.log10(max(float(asked), 10**low))
        width = 100 * np.clip((decades - low) / (high - low), 0.01, 1.0)
        color = "rgb({},{},{})".format(*COLORS.get(name, OTHER))
        lines.append(
            f"<div>{name.replace('_', ' ')}: asks {float(asked):.3g}, "
            f"gets {100 * got:.0f} %</div>"
            f"<div style='width:{width:.0f}%;height:10px;border:1px solid {color};"
            f"margin-bottom:4px'><div style='width:{100 * got:.0f}%;height:100%;"
            f"background:{color}'></div></div>"
        )
    shown = ", ".join(f"{x:.2g}" for x in insight.eigenvalues)
    lines.append(
        "<p>Eigenvalues of the root's metric, relative to the inertia: "
        f"{shown}. Directions below the regularizer are free.</p></div>"
    )
    return "".join(lines)


def obeyed(asked: float, missed: float) -> float:
    """Share of what a branch asks that it gets, in [0, 1]; 1 where it asks nothing."""
    return float(np.clip(1.0 - missed / asked, 0.0, 1.0)) if asked > 1e-9 else 1.0


def status(frame: Frame, pace: float) -> str:
    """One line on what happens: time, pace, clearance, contact."""
    parts = [f"**{frame.time:.2f} s**, pace {pace:.2f}, step {1e3 * frame.cost:.1f} ms"]
    for name, arm in zip(frame.controllers, frame.arms, strict=True):
        near = f"{1e3 * arm.clearance:.0f} mm" if np.isfinite(arm.clearance) else "free"
        hit = f", **HIT {arm.force:.0f} N**" if arm.force > 0.5 else ""
        parts.append(f"{name}: {near}{hit}")
    return "  \n".join(parts)
