"""The playground as a hosted page: what a hub starts."""

import os

from ifo_grounding.cli import main

main(["play", "host=0.0.0.0", f"port={os.environ.get('PORT', '7860')}", "browser=false"])
