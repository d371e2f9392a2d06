"""Docstrings say shapes and units in brackets, as in ``[N, 3] [m]``, which Markdown would take for a link."""

import re

import griffe

#: Brackets outside of code.
OUTSIDE = re.compile(r"(`+[^`]*`+)|([\[\]])")


class Brackets(griffe.Extension):
    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        if obj.docstring is not None:
            obj.docstring.value = OUTSIDE.sub(lambda found: found[1] or f"\\{found[2]}", obj.docstring.value)
