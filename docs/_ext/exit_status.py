"""Sphinx extension: a command `!…` in a code cell must end with exit status 0.

A cell with another status by intention says so in its tags: `:tags: [exit-1]`. The kernel learns it
before the cell, by code that is in no cell. Another status raises, and the build fails.
"""

import re
from typing import Any

from jupyter_cache.executors import utils
from nbclient import NotebookClient

CHECKED = """
def _checked(command, shell=get_ipython()):
    type(shell).system(shell, command)
    if (found := shell.user_ns["_exit_code"]) != {status}:
        raise RuntimeError(f"exit status {{found}}, not {status}: {{command}}")
get_ipython().system = _checked
del _checked
"""
"""replaces what IPython calls for `!…`"""


class Client(NotebookClient):
    """Runs the cells of a page, and their commands with the exit status that is right."""

    async def async_execute_cell(self, cell: Any, *args: Any, **options: Any) -> Any:
        """Run a cell; `!…` raises in it where the status is another."""
        if cell.cell_type == "code" and re.search(r"^\s*!", cell.source, re.MULTILINE):
            tags = " ".join(cell.metadata.get("tags", []))
            status = re.search(r"\bexit-(\d+)", tags)
            code = CHECKED.format(status=status[1] if status else 0)
            self.kc.execute(code, silent=True, store_history=False)
        return await super().async_execute_cell(cell, *args, **options)


def execute(nb: Any, cwd: str, **options: Any) -> Any:
    """Run a page, as `nbclient.execute` does."""
    return Client(nb, resources={"metadata": {"path": cwd}}, **options).execute()


def setup(app: Any) -> dict[str, bool]:
    """Put the client in the place of jupyter-cache's."""
    utils.executenb = execute
    return {"parallel_read_safe": True}
