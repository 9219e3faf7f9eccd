"""Accuracy and its cost: a short pilot predicts what a wanted accuracy costs, and budgets spend samples accordingly.

``quantity`` defines what is estimated as a sum of terms, ``tiles`` where on the image samples are spent, and
``statistics`` how variances are estimated. ``pilot`` measures, ``report`` predicts, ``allocation`` splits a budget over
terms, and ``budget`` spends it.
"""

from warp_psdr.accuracy.allocation import Allocation
from warp_psdr.accuracy.budget import Reached
from warp_psdr.accuracy.report import Report, TermReport

__all__ = ["Allocation", "Reached", "Report", "TermReport"]
