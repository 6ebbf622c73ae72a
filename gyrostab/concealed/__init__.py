"""Recordings with effects hidden in them, by physics that the diagnosis does not share, and the score of what it found.

Nothing here knows `gyrostab.physics`, `gyrostab.simulate`, `gyrostab.noise` or `gyrostab.diagnose`: a diagnosis that is right about these
recordings is right about more than its own formulas.
"""

from gyrostab.concealed.case import make_case as make_case
from gyrostab.concealed.plan import plan_case as plan_case
from gyrostab.concealed.plan import plan_cases as plan_cases

__all__ = ["make_case", "plan_case", "plan_cases"]
