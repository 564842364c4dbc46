import json

import numpy as np

from experiments.curves import draw, read


def test_curves_are_read_by_seed_and_drawn(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    rows = [(8, 0, None), (8, 1, None), (16, 0, 0.5), (16, 1, None), (24, 0, 1.0), (24, 1, 0.25)]
    lines = [json.dumps({"step": s, "seed": k, "last100_ext_return": v}) for s, k, v in rows]
    (run / "metrics.jsonl").write_text("\n".join(lines) + "\n")
    curves = read(run, "last100_ext_return")
    np.testing.assert_array_equal(curves[0], [[16, 24], [0.5, 1.0]])
    np.testing.assert_array_equal(curves[1], [[24], [0.25]])
    draw({"ppo": run, "something": run}, "title", "return", tmp_path / "out" / "curves.png")
    assert (tmp_path / "out" / "curves.png").read_bytes().startswith(b"\x89PNG")
