"""`python -m relit`: the same as the `relit` command."""

from relit.cli.main import command

if __name__ == "__main__":
    command()
