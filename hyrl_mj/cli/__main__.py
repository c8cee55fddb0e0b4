"""`python -m hyrl_mj.cli` is `hyrl-mj`."""

from hyrl_mj.cli.main import main

main()
