"""Commands, each a few lines over `kraft`; related ones share a module."""
