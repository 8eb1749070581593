"""Motion models and sensors of functions, and with some of their functions changed."""

import dataclasses

from jaxslam.core.protocols import Motion, Sensor
from jaxslam.core.record import record


def _method(value):
    return staticmethod(value) if callable(value) else value


def motion_of(**parts):
    """A motion model without leaves, of functions and names."""
    return made(Motion, **parts)


def sensor_of(**parts):
    """A sensor without leaves, of functions and names."""
    return made(Sensor, **parts)


def made(base, **parts):
    return record(type("Own", (base,), {name: _method(part) for name, part in parts.items()}))()


def changed(model, **parts):
    """The model with some functions or names in place of its own; its fields stay."""
    fields = {field.name: getattr(model, field.name) for field in dataclasses.fields(model)}
    own = {name: _method(part) for name, part in parts.items() if name not in fields}
    kind = type(model)
    made = record(type(kind.__name__, (kind,), own | {"name": model.name}))
    return made(**{name: parts.get(name, value) for name, value in fields.items()})
