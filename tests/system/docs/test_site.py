"""The pages as Sphinx builds them: without a warning, every link found, and nothing fetched from elsewhere."""

import os
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]


@pytest.mark.slow
@pytest.mark.seeds
def test_the_site_is_built_without_a_warning(tmp_path, finished_process):
    site = tmp_path / "site"
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-d", str(tmp_path / "read")]
    done = finished_process([*command, str(ROOT / "docs"), str(site)], tmp_path, dict(os.environ))
    assert done.returncode == 0, done.stderr
    pages = sorted(site.rglob("*.html"))
    names = {str(page.relative_to(site)) for page in pages}
    assert names >= {
        "index.html",
        "tutorials/vo2.html",
        "reference/generated/commands.html",
        "reference/generated/journal-schema.html",
        "explanation/operators.html",
        "decisions/0001-sqlite-is-the-record.html",
    }
    for page in pages:
        text = page.read_text(encoding="utf-8")
        fetched = re.findall(r'<(?:script|img|iframe)[^>]+src="([^"]+)"', text)
        fetched += re.findall(r'<link[^>]+rel="(?:stylesheet|preload|icon)"[^>]+href="([^"]+)"', text)
        assert not [address for address in fetched if re.match(r"(?:https?:)?//", address)], page
    commands = (site / "reference/generated/commands.html").read_text(encoding="utf-8")
    assert "bench identify" in commands
    assert "--no-rehearse" in commands
