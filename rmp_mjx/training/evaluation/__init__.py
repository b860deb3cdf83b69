"""Evaluation of a policy: episodes, statistics, tables, figures, films."""
