"""Measures of a policy: fixed rallies, their outcomes, and rates with confidence intervals."""
