"""One HTML file to send to somebody without Python or Blender:

python examples/04_page.py RUN FILE.html
"""

import sys

import relit

file = relit.load(sys.argv[1]).export(sys.argv[2])
print(f"{file}: {file.stat().st_size / 1e6:.1f} MB, opens in any browser, fetches nothing")
