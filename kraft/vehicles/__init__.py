"""Vehicle models, each a derivative over tuples; their parameters come from `configs/vehicles/`."""
