"""Import paths: what they name, and how wrong ones are refused."""

import sys

import pytest

from eddies.import_path import ImportPathError, load, origins, search_in, short_name


def test_the_class_of_a_path_and_its_origin(own):
    path = own("own_ideas", "class Thing:\n    pass\n")
    assert load("own_ideas:Thing").__name__ == short_name("own_ideas:Thing") == "Thing"
    before = origins(["own_ideas:Thing", "numpy:ndarray"])
    assert before["own_ideas:Thing"]["version"] is None and before["numpy:ndarray"]["version"]
    path.write_text(path.read_text() + "# changed\n")
    assert origins(["own_ideas:Thing"])["own_ideas:Thing"]["sha256"] != before["own_ideas:Thing"]["sha256"]


@pytest.mark.parametrize("path, message", [
    ("own_empty", '"own_empty": an import path is "module:name", such as'), (":Thing", "an import path is"),
    ("own_empty:a.b", "an import path is"),
    ("own_missing:Thing", '"own_missing:Thing": there is no module "own_missing"; put it beside'),
    ("own_hungry:Thing", 'there is no module "own_missing", which it imports'),
    ("own_empty:Thing", '"own_empty:Thing": own_empty has no Thing'),
    ("own_broken:Thing", "importing own_broken fails: ZeroDivisionError: division by zero"),
    ("own_ending:Thing", "importing own_ending fails: SystemExit: 3"),
])
def test_bad_path(own, path, message):
    own("own_empty", "")
    own("own_hungry", "import own_missing\n")
    own("own_broken", "1 / 0\n")
    own("own_ending", "raise SystemExit(3)\n")
    with pytest.raises(ImportPathError) as error:
        load(path)
    assert message in str(error.value)


def test_a_folder_is_searched_last_and_once(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = list(sys.path)
    search_in(tmp_path)
    search_in(tmp_path / ".")
    assert sys.path == [*before, str(tmp_path)]
