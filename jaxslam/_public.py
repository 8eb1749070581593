"""Public names say that they are of the module in which users find them, not of a private file."""

import sys

__all__ = ["publish"]


def publish(module: str, *values: object) -> None:
    """Make values, by default those that a module lists in `__all__`, of this module.

    `help`, `repr`, the names of classes in tracebacks, and pickles then show the path that stays,
    `jaxslam.filters.EkfSlam`. The module with the source stays in `__source_module__`.
    """
    namespace = vars(sys.modules[module])
    for value in values or map(namespace.get, namespace["__all__"]):
        source = getattr(value, "__module__", None) or ""
        # Only a class or a function has a qualified name; "._" is in the path of a private file.
        if hasattr(value, "__qualname__") and source.startswith("jaxslam.") and "._" in source:
            setattr(value, "__source_module__", source)  # noqa: B010
            setattr(value, "__module__", module)  # noqa: B010
            # `inspect.getsource` would look for this line in the file of the public module.
            if "__firstlineno__" in vars(value):
                delattr(value, "__firstlineno__")
