"""What is in a folder of photos, and what is odd about it: python examples/01_inspect.py PHOTOS"""

import sys

import relit

found = relit.inspect(sys.argv[1])
print(f"{found['photos']} photos, read as {found['format']}, cameras {found['cameras']}")
print(f"the light looks {found['light_regime']['guess']}:")
for sentence in found["light_regime"]["evidence"]:
    print(f"  {sentence}")
for warning in found["warnings"]:
    print(f"warning: {warning['what']} ({warning['fix']})")
