"""Reading an upload of any format to the samples that it must give."""

import numpy as np
import pandas as pd

from service.datasets.formats.opening import open_table
from service.datasets.mapping.mapping import map_columns
from service.datasets.options import ReadOptions, UploadOptions
from tests.service.datasets.mapping_tables import canonical, motion
from tests.service.datasets.reading import read_blocks, settings_of

DATA = motion(40, 3)
FRAME = pd.DataFrame(canonical(DATA)).round(9)
JOINTS = ["elbow", "shoulder", "wrist"]
STAMP = 1_700_000_000
STAMPS = pd.to_datetime(STAMP * 10**9 + (DATA["t"] * 1e9).round().astype(np.int64)).to_series(index=FRAME.index)


def samples(folder, body, reply=None):
    """Read an upload; return its quantities in SI units, and the joint names."""
    path = folder / "upload"
    path.write_bytes(body)
    with open_table(path, None, reply or ReadOptions(), settings_of(folder)) as table:
        result = read_blocks(table)
        mapped = map_columns(
            table.names, table.units, table.joint_names, UploadOptions(reply or ReadOptions()), None, 40
        )
    columns = list(result.columns.values())
    sources = {"t": mapped.t, **mapped.quantities}
    found = {
        name: np.transpose([each.factor * columns[each.index] for each in row]) for name, row in sources.items() if row
    }
    return found | {"joints": mapped.joints, "facts": result.facts}


def check_same(found, names=("t", "q", "tau"), joints=None, time_error=2e-9):
    """Check that quantities are those of DATA, times since the first one."""
    for name in names:
        if name == "t":
            t = found["t"].sum(axis=1)
            np.testing.assert_allclose(t - t[0], DATA["t"], rtol=0, atol=time_error)
        else:
            np.testing.assert_allclose(found[name], DATA[name], rtol=0, atol=1e-8)
    assert joints is None or found["joints"] == tuple(joints)
