"""Five tests that a causal forecaster should pass, as numbers."""

from tipl.checks.copies import RefitConfig
from tipl.checks.measures import Checks, check
from tipl.checks.model import check_model, refit_of

__all__ = ["Checks", "RefitConfig", "check", "check_model", "refit_of"]
