import hashlib
import subprocess
import sys

import pytest

from experiments.storage.append_log import AppendLog, read_until_mark


def test_AppendLog_resumed_continues_at_its_mark(tmp_path):
    path = tmp_path / "log"
    log = AppendLog(path)
    log.write("one\n")
    mark = log.mark()
    assert mark == {"bytes": 4, "sha256": hashlib.sha256(b"one\n").hexdigest()}
    log.write("two, half a li")
    log.flush()
    log.close()
    again = AppendLog(path, mark)
    again.write("zwei\n")
    assert again.mark()["sha256"] == hashlib.sha256(b"one\nzwei\n").hexdigest()
    again.close()
    assert path.read_text() == "one\nzwei\n"
    AppendLog(path).close()
    assert path.read_text() == ""


def test_AppendLog_changed_before_its_mark_is_refused_and_unchanged(tmp_path):
    path = tmp_path / "log"
    log = AppendLog(path)
    log.write("one\ntwo\n")
    mark = log.mark()
    log.close()
    damaged = (("one\ntwp\n", "does not match"), ("one\n", "does not match"), (None, "missing"))
    for text, words in damaged:
        path.unlink() if text is None else path.write_text(text)
        with pytest.raises(ValueError, match=words):
            read_until_mark(path, mark)
        with pytest.raises(ValueError, match=words):
            AppendLog(path, mark)
        assert path.exists() == (text is not None)
        assert text is None or path.read_text() == text


def test_AppendLog_full_disk_writes_no_partial_line(tmp_path):
    """Use RLIMIT_FSIZE as the size of the disk: the system writes what fits, then refuses."""
    code = f"""
import resource, signal
from pathlib import Path
from experiments.storage.append_log import AppendLog
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (30, 30))
log = AppendLog(Path({str(tmp_path / "log")!r}))
log.write("a line of twenty....\\n")
log.flush()
for _ in range(2):
    log.write("another line of some thirty bytes\\n")
    try:
        log.flush()
    except OSError:
        print("refused")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "refused\nrefused\n"
    assert (tmp_path / "log").read_text() == "a line of twenty....\n"
