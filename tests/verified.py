"""What a verification found, by name."""


def by_name(report, name):
    (check,) = [c for c in report.checks if c.name == name]
    return check


def failed(report):
    names = [c.name for c in report.checks if not c.passed]
    return sorted(names + [f.name for f in report.findings if not f.passed])
