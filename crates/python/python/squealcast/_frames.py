"""Tables for pandas, where it is installed."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import pandas

    from ._native import Predictions, Sweep


def of_predictions(predictions: Predictions) -> pandas.DataFrame:
    """One row for each mode of each condition."""
    import pandas

    ids = np.atleast_1d(predictions.mode_id)
    there = ids >= 0

    def of_condition(values: Any) -> Any:
        return np.broadcast_to(np.asarray(values)[..., np.newaxis], ids.shape)[there]

    columns = {name: of_condition(getattr(predictions, name)) for name in ("load_n", "speed_rad_s", "mu")}
    for name in (
        "mode_id",
        "frequency_hz",
        "growth_rate_per_s",
        "damping_ratio",
        "pad_participation",
        "residual",
        "frequency_error_hz",
        "growth_rate_error_per_s",
    ):
        columns[name] = getattr(predictions, name)[there]
    return pandas.DataFrame(columns)


def of_sweep(sweep: Sweep) -> pandas.DataFrame:
    """One row for each mode at each value."""
    import pandas

    conditions = ["load_n", "speed_rad_s", "mu"]
    if not np.isnan(sweep.temperature_c).all():
        conditions.append("temperature_c")
    names = [*conditions, "mode_id", "frequency_hz", "growth_rate_per_s", "damping_ratio"]
    return pandas.DataFrame({name: getattr(sweep, name) for name in names})


def columns_of_csv(text: str) -> dict[str, np.ndarray[Any, Any]]:
    """The columns of comma-separated values: numbers where all cells are, NaN for empty ones, else text."""
    header, *rows = csv.reader(io.StringIO(text))
    columns: dict[str, np.ndarray[Any, Any]] = {}
    for name, cells in zip(header, zip(*rows) if rows else [()] * len(header)):
        try:
            columns[name] = np.array([float(cell or "nan") for cell in cells])
        except ValueError:
            columns[name] = np.array(cells, dtype=object)
    return columns


def of_columns(columns: dict[str, Any]) -> pandas.DataFrame:
    """A table of columns, indexed by the stamp if there is one; a column with rows becomes several."""
    import pandas

    flat = {}
    for name, values in columns.items():
        if name != "stamp_ns" and values.ndim == 2:
            flat.update({f"{name}_{k}": values[:, k] for k in range(values.shape[1])})
        elif name != "stamp_ns":
            flat[name] = values
    index = None
    if "stamp_ns" in columns:
        index = pandas.DatetimeIndex(pandas.to_datetime(columns["stamp_ns"], unit="ns", utc=True), name="stamp")
    return pandas.DataFrame(flat, index=index)
