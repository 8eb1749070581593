"""Whether XLA passes arrays to its computations in the layouts that these were compiled for."""

import re

import jax

_COMPUTATION = re.compile(r"(?:ENTRY )?%?([\w.\-]+) \(.*\) -> .*\{$")
_INSTRUCTION = re.compile(r"\s+(ROOT )?%([\w.\-]+) = (\([^=]*?\)|\S+) ([\w\-]+)\((.*)$")


def kept_programs():
    """The compiled programs that the process keeps."""
    return set(jax.devices()[0].client.live_executables())


def wrong_layouts(before=()):
    """Calls in the kept programs, but for those of `before`, with another layout than their
    computation was compiled for, which give wrong numbers (jaxlib 0.12)."""
    texts = (program.hlo_modules()[0].to_string() for program in kept_programs() - set(before))
    return [one for text in texts for one in mismatches(text)[0]]


def mismatches(text):
    """Of the text of a compiled program: (calls with another layout than the callee's, calls)."""
    parameters, roots, shapes, calls = {}, {}, {}, []
    here = None
    for line in text.splitlines():
        if not line.startswith(" "):
            found = _COMPUTATION.match(line)
            here = found[1] if found else here
            continue
        found = _INSTRUCTION.match(line)
        if not found:
            continue
        is_root, name, shape, operation, rest = found.groups()
        shape = re.sub(r"/\*.*?\*/", "", shape)
        shapes[here, name] = shape
        if operation == "parameter":
            parameters[here, int(re.match(r"\d+", rest)[0])] = shape
        if is_root:
            roots[here] = shape
        if operation == "call":
            operands = re.findall(r"%([\w.\-]+)", rest.split(")")[0])
            calls.append((here, name, shape, operands, re.search(r"to_apply=%([\w.\-]+)", rest)[1]))
    bad = []
    for caller, name, shape, operands, callee in calls:
        for i, operand in enumerate(operands):
            if shapes[caller, operand] != parameters[callee, i]:
                bad.append(f"{name}: operand {i} is {shapes[caller, operand]}")
        if shape != roots[callee]:
            bad.append(f"{name}: result is {shape}")
    return bad, len(calls)
