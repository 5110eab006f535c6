"""``python -m amibayes`` is the command ``amibayes``."""

from amibayes.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
