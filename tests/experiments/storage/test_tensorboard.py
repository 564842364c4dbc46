"""Read the files with the records of tensorboardX: the requirements hold no other reader."""

from helpers.processes import events

from experiments.storage.tensorboard import TensorBoardWriter


def line(step, seed=4):
    return {"step": step, "seed": seed, "episodes": 1, "loss": 0.5 * step, "ext_return": None}


def test_TensorBoardWriter_numbers_become_scalars_of_their_seed(tmp_path):
    boards = TensorBoardWriter(tmp_path, [4, 5])
    boards.add(line(8), 100.0)
    boards.add(line(8, 5), 100.0)
    boards.close()
    first, start, event = events(tmp_path / "seed_5")
    assert first.file_version == "brain.Event:2"
    assert start.session_log.status == 1  # START
    assert (event.step, event.wall_time) == (8, 100.0)
    assert [(v.tag, v.simple_value) for v in event.summary.value] == [("loss", 4.0)]


def test_TensorBoardWriter_resumed_run_has_one_curve(tmp_path):
    boards = TensorBoardWriter(tmp_path, [4])
    boards.add(line(8), 1.0)
    boards.add(line(16), 2.0)
    boards.flush()  # the run is killed here
    again = TensorBoardWriter(tmp_path, [4])
    again.add(line(8), 1.0)
    again.add(line(16), 3.0)
    again.close()
    assert [event.step for event in events(tmp_path / "seed_4")[2:]] == [8, 16]
