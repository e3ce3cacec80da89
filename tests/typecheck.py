"""The type checker that runs under the tests: an int is a float, as static checkers have it."""

from beartype import BeartypeConf, beartype

typecheck = beartype(conf=BeartypeConf(is_pep484_tower=True))
