"""``python -m weighttraj``: the command line."""

from weighttraj.cli import main

if __name__ == "__main__":
    main()
