#!/bin/sh
# Two worlds in which things move: the monsters of a corridor at 96x128 (the bundled doom-corridor), and three maps of Freedoom
# at 48x64 with a fourth never seen. Run it in the folder of a checkout after `make test`; every command goes on where it was
# stopped.
set -e
PATH=.venv/bin:$PATH
export OMP_NUM_THREADS=1
# The place is learned from pictures of twice its size, which its memory keeps; what its things do from many more and smaller ones.
terrella record doom --scenario deadly_corridor --skill 3 --frames 40000 --seed 0 --out recordings/monsters
terrella record doom --scenario deadly_corridor --skill 3 --frames 4000 --seed 1 --out recordings/monsters-test
terrella record doom --height 96 --scenario deadly_corridor --skill 3 --frames 80000 --seed 2 --out recordings/fights
terrella record doom --height 96 --scenario deadly_corridor --skill 3 --frames 16000 --seed 7 --out recordings/fights-test
terrella train video recordings/monsters --out runs/monsters --name doom-corridor --steps 3500 --motion-steps 4000 \
    --keyframes 200 --critic-from 900 --estimator-steps 0 --uncertainty-frames 2000
terrella train objects runs/monsters/world --data recordings/fights --out runs/monsters/things
terrella score runs/monsters/things --data recordings/monsters-test --fresh --out scores/monsters --horizons 1 8 32 \
    --clips 24 --drift 0 --long-steps 0
python lab/things.py runs/monsters/things recordings/fights-test

terrella record doom --height 96 --scenario freedoom2/MAP01,MAP02,MAP05 --frames 18000 --seed 0 --out recordings/maps
terrella record doom --height 96 --scenario freedoom2/MAP03 --frames 3000 --seed 1 --out recordings/map03
terrella train video recordings/maps --out runs/maps --name doom-maps --size 48 64 --steps 3000 \
    --motion-steps 2500 --outcome-steps 700 --keyframes 420 --critic-from 900 --estimator-steps 0 --uncertainty-frames 0
terrella score runs/maps --data recordings/maps --new recordings/map03 --out scores/maps --horizons 1 8 32
