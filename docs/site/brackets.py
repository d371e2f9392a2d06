"""Escapes brackets in docstrings: shapes and units like ``[N, 3] [m]`` would be links in Markdown."""

import re

import griffe

#: Brackets outside of code.
OUTSIDE = re.compile(r"(`+[^`]*`+)|([\[\]])")


class Brackets(griffe.Extension):
    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        if obj.docstring is not None:
            obj.docstring.value = OUTSIDE.sub(lambda found: found[1] or f"\\{found[2]}", obj.docstring.value)
