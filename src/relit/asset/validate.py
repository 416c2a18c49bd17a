"""The Khronos glTF validator, where node and its npm package are present."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

from relit.errors import EXIT_ENVIRONMENT, UserError

SCRIPT = """
const fs = require('fs'), path = require('path');
const validator = require(path.join(process.argv[1], 'gltf-validator'));
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])), {maxIssues: 200})
  .then(r => console.log(JSON.stringify(r.issues)), e => { console.error(String(e)); process.exit(1); });
"""


def find_validator() -> tuple[str, Path] | str:
    """(node, node_modules folder), or one sentence that says what is missing. `RELIT_NODE_MODULES`
    names another folder."""
    node = shutil.which("node")
    if node is None:
        return "node is not installed"
    root = Path(__file__).resolve().parents[3]
    given = os.environ.get("RELIT_NODE_MODULES")
    folder = Path(given) if given else root / "tools" / "validator" / "node_modules"
    if not (folder / "gltf-validator").is_dir():
        return "the npm package gltf-validator is not installed (npm ci --prefix tools/validator)"
    return node, folder.resolve()


def validate_glb(path: str | Path) -> dict:
    """The validator's verdict on a .glb: {'numErrors', 'numWarnings', 'numInfos', 'messages':
    [...]}.

    Raises UserError (exit code 5) when node or the package is missing, and when the validator
    itself fails.
    """
    found = find_validator()
    if isinstance(found, str):
        raise UserError(
            "the glTF validator cannot run",
            found,
            "install node 18 or newer, then: make validator",
            code=EXIT_ENVIRONMENT,
        )
    node, folder = found
    done = subprocess.run(
        [node, "-e", SCRIPT, str(folder), str(path)], capture_output=True, text=True, timeout=120
    )
    if done.returncode:
        raise UserError(
            "the glTF validator failed",
            done.stderr.strip()[-500:],
            f"check the file: {path}",
            code=EXIT_ENVIRONMENT,
        )
    return json.loads(done.stdout)
