"""The files of a release agree on version, licence and maintainer, and name every dependency."""

import json
import re
import shutil
import subprocess
from configparser import ConfigParser
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml

ROOT = Path(__file__).parents[2]
PACKAGES = [ROOT / "package.xml", ROOT / "msg_defs" / "package.xml"]


def setup():
    parser = ConfigParser()
    parser.read(ROOT / "setup.cfg", encoding="utf-8")
    return parser["metadata"]


def citation():
    return yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))


def package_roots():
    return [ElementTree.parse(path).getroot() for path in PACKAGES]


def test_version_and_licence_are_the_same_in_every_file():
    stated = [(setup()["version"], setup()["license"])]
    stated.append((citation()["version"], citation()["license"]))
    stated += [(root.findtext("version"), root.findtext("license")) for root in package_roots()]
    code = (ROOT / "parallel_cal" / "__init__.py").read_text(encoding="utf-8")
    assert f'__version__ = "{setup()["version"]}"' in code
    assert len(stated) == 4
    assert len(set(stated)) == 1, stated


def test_the_maintainer_s_address_is_the_same_in_every_package_xml_and_nowhere_else():
    own = [ElementTree.parse(path).getroot() for path in ROOT.glob("test/*_msgs/package.xml")]
    assert own
    (address,) = {root.find("maintainer").get("email") for root in package_roots() + own}
    steps = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    # As long as it is a placeholder, it must look like one, and the steps of a release name it.
    assert not address.endswith("@example.org") or f"`{address}`" in steps
    assert "maintainer_email" not in setup()
    assert "email" not in str(citation())


@pytest.mark.skipif(not shutil.which("make"), reason="make is not installed")
def test_one_command_sets_the_maintainer_of_a_release(tmp_path):
    files = [*PACKAGES, *ROOT.glob("test/*_msgs/package.xml")]
    for path in (ROOT / "Makefile", *files):
        copy = tmp_path / path.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, copy)
    said = ["EMAIL=jane@lab.org", "URL=https://git.lab.org/jane/parallel_cal"]
    subprocess.run(["make", "maintainer", *said], cwd=tmp_path, check=True, timeout=60)
    texts = [(tmp_path / path.relative_to(ROOT)).read_text(encoding="utf-8") for path in files]
    assert not any("example.org" in text for text in texts)
    assert all('<maintainer email="jane@lab.org">' in text for text in texts)
    for root in map(ElementTree.fromstring, texts[:2]):
        urls = [url.text.removeprefix("https://git.lab.org/jane/") for url in root.iter("url")]
        assert urls == ["parallel_cal", "parallel_cal.git", "parallel_cal/issues"]
    refused = subprocess.run(["make", "maintainer"], cwd=tmp_path, capture_output=True, timeout=60)
    assert refused.returncode != 0


def test_both_package_xml_state_urls_and_authors():
    for root in package_roots():
        urls = {url.get("type"): url.text for url in root.iter("url")}
        assert set(urls) == {"website", "repository", "bugtracker"}
        assert all(text.startswith("https://") for text in urls.values())
        assert root.findtext("author") == root.findtext("maintainer")


def test_package_xml_names_the_settings_of_rosdoc2():
    """Without this export rosdoc2 ignores the file: its site has README and LICENSE only."""
    settings = ROOT / ElementTree.parse(PACKAGES[0]).getroot().findtext("export/rosdoc2")
    _, documents = yaml.safe_load_all(settings.read_text(encoding="utf-8"))
    (builder,) = documents["builders"]
    assert (ROOT / builder["sphinx"]["sphinx_sourcedir"] / "conf.py").is_file()
    # rosdoc2 says nothing about a setting that it does not know. Of a Python package it would
    # document every module, which takes longer than all of our pages.
    assert set(documents["settings"]) <= {"generate_package_index", "override_build_type"}
    assert documents["settings"]["override_build_type"] != "ament_python"


def test_the_ros_packages_that_the_code_imports_are_declared():
    declared = {e.text for e in ElementTree.parse(PACKAGES[0]).getroot().iter("exec_depend")}
    imported = set()
    ours = {"parallel_cal_msgs"}
    for folder in ("parallel_cal", "launch"):
        for file in (ROOT / folder).rglob("*.py"):
            text = file.read_text(encoding="utf-8")
            names = re.findall(r"^\s*(?:from|import) (\w+)", text, re.M)
            imported |= {n for n in names if n.endswith(("_msgs", "_srvs", "_interfaces"))}
            imported |= {n for n in names if n.startswith(("rclpy", "tf2_ros", "launch"))}
    assert ours < imported
    assert imported - declared == set()


def test_the_changelog_begins_with_the_present_version_in_the_form_of_rep_132():
    lines = (ROOT / "CHANGELOG.rst").read_text(encoding="utf-8").splitlines()
    assert lines[0] == lines[2] == "^" * len(lines[1])
    assert lines[1] == "Changelog for package parallel_cal"
    versions = [
        re.fullmatch(r"(\d+\.\d+\.\d+) \(\d{4}-\d\d-\d\d\)", title)[1]
        for title, line in pairwise(lines)
        if line and set(line) == {"-"}
    ]
    assert versions[0] == setup()["version"]
    assert versions == sorted(versions, reverse=True)
    assert len(versions) > 1


def test_the_changelog_is_valid_restructured_text():
    core = pytest.importorskip("docutils.core")
    text = (ROOT / "CHANGELOG.rst").read_text(encoding="utf-8")
    core.publish_doctree(text, settings_overrides={"halt_level": 2, "report_level": 5})


def test_files_for_continuous_integration_and_containers_can_be_read():
    workflow = yaml.safe_load((ROOT / ".github/workflows/test.yaml").read_text(encoding="utf-8"))
    assert workflow["jobs"]["python"]["strategy"]["matrix"]["python"][0] == "3.10"
    assert ".ci/run" in str(workflow["jobs"]["check"]["steps"])
    assert (
        "make venv"
        in json.loads((ROOT / ".devcontainer/devcontainer.json").read_text())["postCreateCommand"]
    )
    assert yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"]


def test_the_page_on_stability_names_every_extra_for_users():
    parser = ConfigParser()
    parser.read(ROOT / "setup.cfg", encoding="utf-8")
    page = (ROOT / "docs" / "stability.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"parallel_cal\[(\w+)\]", page))
    assert shown == set(parser["options.extras_require"]) - {"peers", "colcon", "test"}


def test_colcon_finds_the_declaration_of_pytest():
    """Without pytest in the extra `test`, `colcon test` runs nothing, and passes."""
    parser = ConfigParser()
    parser.read(ROOT / "setup.cfg", encoding="utf-8")
    extras = parser["options.extras_require"]
    declared = [line for line in extras["test"].splitlines() if line]
    assert "pytest" in {re.split("[<>=]", line)[0] for line in declared}
    assert set(declared) <= set(extras["dev"].splitlines())
