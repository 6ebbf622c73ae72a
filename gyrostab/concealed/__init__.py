"""Recordings with effects hidden in them, by physics that the diagnosis does not share, and the score of what it found.

Nothing here knows `gyrostab.physics`, `gyrostab.simulate`, `gyrostab.noise` or `gyrostab.diagnose`: a diagnosis that is right about these
recordings is right about more than its own formulas.
"""

from gyrostab.concealed.case import make_case as make_case
from gyrostab.concealed.curves import by_effect as by_effect
from gyrostab.concealed.curves import curves as curves
from gyrostab.concealed.curves import reliability as reliability
from gyrostab.concealed.naive import allan_detector as allan_detector
from gyrostab.concealed.naive import channel_detector as channel_detector
from gyrostab.concealed.plan import plan_case as plan_case
from gyrostab.concealed.plan import plan_cases as plan_cases
from gyrostab.concealed.real import make_salted as make_salted
from gyrostab.concealed.real import plan_salted as plan_salted
from gyrostab.concealed.salt import salt as salt
from gyrostab.concealed.salted import salt_differences as salt_differences
from gyrostab.concealed.salted import salt_table as salt_table
from gyrostab.concealed.score import score_case as score_case
from gyrostab.concealed.seal import open_truth as open_truth
from gyrostab.concealed.seal import seal as seal
from gyrostab.concealed.table import markdown as markdown
from gyrostab.concealed.table import missed as missed
from gyrostab.concealed.table import score_table as score_table

__all__ = [
    "allan_detector",
    "by_effect",
    "channel_detector",
    "curves",
    "make_case",
    "make_salted",
    "markdown",
    "missed",
    "open_truth",
    "plan_case",
    "plan_cases",
    "plan_salted",
    "reliability",
    "salt",
    "salt_differences",
    "salt_table",
    "score_case",
    "score_table",
    "seal",
]
