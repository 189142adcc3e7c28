"""Reads a table of a study by DuckDB and by pandas: study_tables.py TABLE. Prints what both found as JSON."""

import json
import sys

import duckdb
import pandas
import pyarrow.parquet

path = sys.argv[1]
frame = pandas.read_parquet(path)
rows = duckdb.sql(f"select * from '{path}' order by \"case\"")
duck = rows.df()
assert list(frame.columns) == list(duck.columns) == rows.columns
lists = []
for column in frame.columns:
    for ours, theirs in zip(frame[column], duck[column]):
        if isinstance(ours, list) or hasattr(ours, "__len__") and not isinstance(ours, str):
            lists.append(len(ours))
            assert [x for x in ours] == [x for x in theirs] or str(list(ours)) == str(list(theirs)), column
        else:
            missing = [pandas.isna(ours), pandas.isna(theirs)]
            assert all(missing) or (not any(missing) and ours == theirs), (column, ours, theirs)
unstable = duckdb.sql(f"select count(*) from '{path}' where unstable_modes > 0").fetchall()[0][0]
assert unstable == int((frame["unstable_modes"] > 0).sum())
metadata = pyarrow.parquet.read_schema(path).metadata
print(
    json.dumps(
        {
            "versions": {"duckdb": duckdb.__version__, "pandas": pandas.__version__, "pyarrow": pyarrow.__version__},
            "columns": list(frame.columns),
            "rows": len(frame),
            "unstable": unstable,
            "longest_list": max(lists),
            "failed": frame.loc[frame["status"] == "failed", ["case", "reason"]].values.tolist(),
            "case_type": str(frame["case"].dtype),
            "metadata": {key.decode(): value.decode() for key, value in metadata.items() if key.startswith(b"squealcast")},
        }
    )
)
