"""Vehicle models, each a derivative over tuples, and their loading; parameters are in `configs/vehicles/`."""
