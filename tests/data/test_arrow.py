"""pandas is not imported by our reading and writing, and is there for who uses it."""

import subprocess
import sys

import pytest

pytest.importorskip("pandas")
STORE = "import sys, shiftsim.data.store.tables, pyarrow as pa, numpy as np\n"


def run(code):
    done = subprocess.run([sys.executable, "-c", STORE + code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_arrays_do_not_import_pandas():
    code = "pa.array([1]), pa.array(np.ones(3)).to_numpy(); print('pandas' in sys.modules)"
    assert run(code) == "False\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    "code",
    [
        "import pandas as pd; print(pa.array(pd.Series(['a'], dtype='category')).dictionary)",
        "import pandas as pd; print(pa.table(pd.DataFrame({'a': [1]}))['a'])",
        "print(type(pa.table({'a': [1]}).to_pandas()))",
    ],
)
def test_pandas_works_with_arrow_as_without_us(code):
    plain = subprocess.run(
        [sys.executable, "-c", f"import pyarrow as pa; {code}"], capture_output=True, text=True
    )
    assert run(code) == plain.stdout != ""
