"""`python -m deltas_nets` is the `deltas` command."""

from deltas_nets.cli import main

if __name__ == "__main__":
    main()
