.PHONY: check test format

# Format, lint, types and tests: what has to pass before a commit.
check: format
	ruff check .
	mypy
	pytest

test:
	pytest

format:
	ruff format .
