"""How a notebook displays a result."""

from __future__ import annotations


class ShownInNotebook:
    """Gives a result a rich display: the tables that the command line prints, as HTML.

    They are made by `parallel_cal.show`, far above this room. It is reached through the public
    names, as a user would reach it, so that results need not know how they are printed.
    """

    def _repr_html_(self) -> str:
        import parallel_cal

        return parallel_cal.show(self, html=True)
