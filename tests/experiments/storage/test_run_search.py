import os

from experiments.storage.run_search import find_run_directories


def run_in(path):
    path.mkdir(parents=True)
    (path / "config.yaml").write_text("")
    return path


def test_find_run_directories_links_to_runs_are_followed(tmp_path):
    one, two = run_in(tmp_path / "store" / "a"), run_in(tmp_path / "store" / "deep" / "b")
    place = tmp_path / "links"
    place.mkdir()
    (place / "one").symlink_to(one)
    (place / "deep").symlink_to(two.parent, target_is_directory=True)
    assert find_run_directories(place) == ([place / "deep" / "b", place / "one"], [])
    (tmp_path / "link to links").symlink_to(place)
    found, _ = find_run_directories(tmp_path / "link to links")
    assert [path.name for path in found] == ["b", "one"]


def test_find_run_directories_run_with_several_links_is_found_once_without_links(tmp_path):
    run = run_in(tmp_path / "z" / "run")
    for name in ("a", "b"):
        (tmp_path / name).symlink_to(run)
    (tmp_path / "c").symlink_to(tmp_path / "z")
    assert find_run_directories(tmp_path) == ([run], [])


def test_find_run_directories_circles_of_links_end(tmp_path):
    place = tmp_path / "place"
    run = run_in(place / "x" / "run")
    other = run_in(place / "y" / "run")
    run_in(tmp_path / "outside")
    (place / "x" / "across").symlink_to(place / "y")
    (place / "y" / "back").symlink_to(place / "x")
    (run / "parent").symlink_to(tmp_path)  # a parent of the place: what is beside is not asked for
    (place / "root").symlink_to("/")
    os.symlink("self", place / "self")
    found, left_out = find_run_directories(place)
    assert found == [run, other]
    ((path, reason),) = left_out
    assert path == place / "self"
    assert reason.startswith("a symbolic link that cannot be followed")


def test_find_run_directories_link_to_nothing_is_named(tmp_path):
    (tmp_path / "gone").symlink_to(tmp_path / "moved away")
    found, left_out = find_run_directories(tmp_path)
    assert found == []
    assert left_out == [
        (tmp_path / "gone", f"a symbolic link to nothing: {tmp_path / 'moved away'}")
    ]


def test_find_run_directories_without_links_equals_a_recursive_glob(tmp_path):
    for name in ("a", "a/inner", "b/c/d", ".hidden/e"):
        run_in(tmp_path / name)
    (tmp_path / "file").write_text("")
    found, left_out = find_run_directories(tmp_path)
    assert found == sorted(path.parent for path in tmp_path.rglob("config.yaml"))
    assert left_out == []
