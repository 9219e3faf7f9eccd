"""Accuracy and its price: what a wanted accuracy costs, measured by a short pilot, and budgets that are spent by it.

``quantity`` says what is estimated as a sum of terms, ``tiles`` where on the image samples are spent, ``statistics``
how variances are estimated, ``pilot`` measures, ``report`` predicts, ``allocation`` splits, ``budget`` spends.
"""

from warp_psdr.accuracy.allocation import Allocation
from warp_psdr.accuracy.budget import Reached
from warp_psdr.accuracy.report import Report, TermReport

__all__ = ["Allocation", "Reached", "Report", "TermReport"]
