"""What ``psdr.solve`` can find: entries of parameters, rigid motions, numbers of any function."""

from warp_psdr.observe.unknowns import Entries, Function, Rigid

__all__ = ["Entries", "Function", "Rigid"]
