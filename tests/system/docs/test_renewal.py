"""The scripts that put tables of campaigns into pages know every table and every change of the campaign files."""

import importlib
import sys
from pathlib import Path

import pytest

from bench.batch import read_campaign
from bench.batch.campaign.file import axes, dotted

ROOT = Path(__file__).parents[3]
ROBUSTNESS = read_campaign(ROOT / "examples" / "campaign-robustness.toml")
CONTROLLED = {table.name: table for table in ROBUSTNESS.tables.runs if "model" in table.parameters}


@pytest.fixture(scope="module")
def of_docs():
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        yield importlib.import_module
    finally:
        sys.path.remove(str(ROOT / "docs"))


@pytest.fixture(scope="module")
def renewal(of_docs):
    return of_docs("renew_controllers")


def test_the_tables_of_the_page_are_those_of_the_campaign(renewal, of_docs):
    assert {name.partition(" ")[0] for name in renewal.ROBUSTNESS} == set(CONTROLLED)
    page = (ROOT / "docs" / "reference" / "robustness.md").read_text(encoding="utf-8")
    shown = of_docs("renew_measured").MARKS.findall(page)
    assert shown
    for name in shown:
        assert f"<!-- table {name} -->\n| {renewal.ROBUSTNESS[name].unit} |" in page, name


@pytest.mark.parametrize("name", CONTROLLED)
def test_each_change_has_a_title_of_its_own(renewal, name):
    shown = renewal.ROBUSTNESS[name]
    changes = axes(dotted(CONTROLLED[name].overrides))[shown.varies]
    titles = [renewal.title(change, shown.nominal) for change in map(_inline, changes)]
    assert titles[0] == shown.nominal
    assert len({*titles}) == len(titles)


def _inline(change):
    return change if isinstance(change, str) else "{" + ", ".join(f"{k} = {v}" for k, v in change.items()) + "}"


def test_the_table_of_the_choice_has_a_row_for_each_record_and_a_column_for_each_plant(of_docs):
    renewal = of_docs("renew_selection")
    outcome = renewal.Outcome
    found = [outcome("duhem", error, "duhem", 1.0, 3.0, ("one-run", "one-kind"), 9.0) for error in (1.1, 2.5, 1.3)]
    assert renewal.row("mixed", {"duhem": found}) == "| mixed | – | 1.30 | – | – | one-kind |"
    rows = renewal.PAGE.read_text(encoding="utf-8").partition("<!-- table synthetic -->\n")[2].splitlines()
    assert rows[0] == f"| record | {' | '.join(renewal.PLANTS)} | advice |"
    kinds = [line.split(" | ")[0].removeprefix("| ") for line in rows[2 : rows.index("<!-- end -->")]]
    assert kinds == list(renewal.KINDS)
