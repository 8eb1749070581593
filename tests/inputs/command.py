"""The command `jaxslam`, run in this process."""

from jaxslam import _cli as cli


def run_command(words):
    """The exit status of the command with these words, or what str makes words of."""
    return cli.main([str(word) for word in words])
