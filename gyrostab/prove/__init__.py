"""The benchmark of concealed effects: draw cases, seal the truth, diagnose the recordings alone, open the seal, count."""

from gyrostab.prove.core import Proof as Proof
from gyrostab.prove.core import prove as prove

__all__ = ["Proof", "prove"]
