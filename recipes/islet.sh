#!/bin/sh
# Makes the bundled world islet from nothing, in the folder of a checkout after `make test`: record, train, put in place, score.
# It is learned from pictures and actions alone, of our own small game (src/terrella/sim/islet.py).
set -e
PATH=.venv/bin:$PATH
terrella record world gym:Islet-v0 --frames 20000 --seed 0 --out recordings/islet
# On a GPU in eight minutes; without one the last line of this command is --hours 1.2 --steps 20000, and the world a little softer.
terrella train video recordings/islet --out runs/islet --name islet --preset small --outcome-steps 400 \
  --device cuda --hours 0.13 --steps 60000
# In eight minutes there is no time for its uncertainty; this learns it from 9,000 frames of rollouts.
terrella train uncertainty runs/islet --data recordings/islet --out runs/islet-uncertainty
mkdir -p src/terrella/bundled
rm -rf src/terrella/bundled/islet
cp -r runs/islet-uncertainty/world src/terrella/bundled/islet
# Scores come from a recording of its own, of which training saw nothing.
terrella record world gym:Islet-v0 --frames 3000 --seed 5 --out recordings/islet-test
terrella score islet --data recordings/islet-test --fresh --clips 24 --horizons 1 8 32 --long-steps 0 --drift 0 --out scores/islet
# To see both side by side: terrella play islet --compare
