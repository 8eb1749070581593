"""The extension that checks the exit status of `!…` in the cells of pages, in one kernel."""

import broken
from test_docs import ROOT


def test_a_command_in_a_cell_ends_with_the_status_that_its_tag_says(monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(ROOT / "docs" / "_ext")
    nbformat = broken.optional("nbformat")
    cache = broken.optional("myst_nb.core.execute.cache")
    import exit_status

    monkeypatch.setattr(exit_status.utils, "executenb", None)
    exit_status.setup(None)
    cells = [
        nbformat.v4.new_code_cell("!exit 3", metadata={"tags": ["exit-3", "hide-input"]}),
        nbformat.v4.new_code_cell("!true\nprint(_exit_code, 'not', 3)"),
        nbformat.v4.new_code_cell("!false\n!true"),
        nbformat.v4.new_code_cell("print('never run')"),
    ]
    page = nbformat.v4.new_notebook(cells=cells)
    done = cache.single_nb_execution(page, cwd=str(tmp_path), timeout=60, allow_errors=False)
    assert "exit status 1, not 0: false" in str(done.err)
    assert [cell.execution_count for cell in cells] == [1, 2, 3, None]
    assert cells[1].outputs[0].text == "0 not 3\n"
