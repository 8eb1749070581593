"""The docstrings of fields of named tuples, where `help` finds them.

Python keeps no docstring below a field: `help` says "Alias for field number 0". They are read from
the source, by a regular expression, since parsing it would take longer than the import.
"""

import re
import sys
from pathlib import Path

_CLASS = re.compile(r"^class (\w+)\(NamedTuple.*\n((?:(?: .*)?\n)*)", re.M)
_FIELD = re.compile(
    r'^    (\w+): .*\n(?:        .*\n|    [\])].*\n)*    """([^"]*(?:"[^"]+)*?)"""', re.M
)


def attach_field_docs() -> None:
    """Give the fields of all named tuples of the package that are imported their docstrings."""
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] != "jaxslam":
            continue
        records = [
            value
            for value in vars(module).values()
            if isinstance(value, type)
            and value.__module__ == name
            and issubclass(value, tuple)
            and hasattr(value, "_fields")
        ]
        try:
            source = Path(module.__file__ or "").read_text(encoding="utf-8") if records else ""
        except OSError:  # installed without its source
            continue
        bodies = dict(_CLASS.findall(source))
        for record in records:
            texts = dict(_FIELD.findall(bodies.get(record.__name__, "")))
            for field in record._fields:
                getattr(record, field).__doc__ = texts.get(field)
