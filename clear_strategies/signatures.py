"""Signatures and annotations of users' functions and classes.

From Python 3.14 on, an annotation is evaluated when it is asked for. One of a name that only type checkers import raises a
NameError then, if it is not left as it is.
"""

from __future__ import annotations

import inspect
import sys
from functools import partial

if sys.version_info >= (3, 14):
    from annotationlib import Format

    signature_of = partial(inspect.signature, annotation_format=Format.FORWARDREF)
    annotations_of = partial(inspect.get_annotations, format=Format.FORWARDREF)
else:
    signature_of, annotations_of = inspect.signature, inspect.get_annotations
