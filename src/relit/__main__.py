"""`python -m relit`: the same as the `relit` command."""

from relit.cli import command

if __name__ == "__main__":
    command()
