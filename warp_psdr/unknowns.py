"""What ``psdr.solve`` can find: entries of parameters, rigid motions, numbers of any function or kernel."""

from warp_psdr.observe.unknowns import Entries, Function, Rigid, Taped

__all__ = ["Entries", "Function", "Rigid", "Taped"]
