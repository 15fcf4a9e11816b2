"""The how-to about notebooks, executed as a notebook: every result shows itself."""

import re
import subprocess
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

PAGE = (Path(__file__).parents[3] / "docs" / "how-to" / "use-a-notebook.md").read_text(encoding="utf-8")
CODE, PRINTED = (
    re.findall(rf"^```{kind}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL) for kind in ("python", "text")
)


@pytest.fixture(scope="module")
def cells(tmp_path_factory, warmly):
    """Execute the blocks of the page; return the outputs by the last line of their cell."""
    import jupyter_client.launcher

    code = [nbformat.v4.new_code_cell(cell) for block in CODE for cell in block.split("\n\n")]
    notebook = nbformat.v4.new_notebook(cells=code)
    folder = tmp_path_factory.mktemp("notebook")
    client = NotebookClient(
        notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    )
    with warmly(), pytest.MonkeyPatch.context() as patch:
        # Its name for this was bound when it was imported.
        patch.setattr(jupyter_client.launcher, "Popen", subprocess.Popen)
        client.execute()
    return {cell.source.splitlines()[-1]: cell.outputs for cell in notebook.cells}


def shown(outputs, kind):
    return [each.data[kind] for each in outputs if each.output_type == "execute_result" and kind in each.data]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "said"),
    [
        ('bench.rehearse("damped-oscillation", "vo2", half_cycles=8, increment="3 K")', "tec_temperature"),
        ("run", "completed"),
        ("run.readings", "curvature [1/m]"),
        ("model", "identifiable coefficients"),
        ("bench.report(run, [model])", "svg"),
        ('bench.runs("runs", protocol="damped-oscillation")', "vo2-damped-oscillation"),
        ('bench.compare(run, bench.runs("runs")[0])', "common steps"),
    ],
)
def test_a_result_is_a_table_or_a_page(cells, line, said):
    (html,) = shown(cells[line], "text/html")
    assert said in html


@pytest.mark.slow
def test_what_is_printed_stands_on_the_page(cells):
    printed = "".join(each.text for outputs in cells.values() for each in outputs if each.output_type == "stream")
    assert len(PRINTED) == len(CODE)
    for line in "".join(PRINTED).splitlines():
        assert line in printed


@pytest.mark.slow
@pytest.mark.parametrize("line", ["run.plot()", 'run.plot("loops")', "model.plot()"])
def test_a_plot_is_a_picture(cells, line):
    (png,) = shown(cells[line], "image/png")
    assert len(png) > 10_000
