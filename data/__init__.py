"""Readers, converters and the scenario store: recordings and maps in, scenarios out."""

if __name__ == "data":  # pragma: no cover
    raise ImportError("import it as shiftsim.data")
