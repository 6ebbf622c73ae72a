"""Dynamic Allan variance: a log to a surface ``(axis, time, tau)``, as a whole or in parts."""

from gyrostab.davar.core import davar as davar
from gyrostab.davar.core import davar_part as davar_part
from gyrostab.davar.core import davar_parts as davar_parts

__all__ = ["davar", "davar_part", "davar_parts"]
