#!/bin/sh
# Makes the bundled world doom-maze from nothing: record, train, put in place, score. About two hours on two cores.
set -e
terrella record doom --scenario my_way_home --frames 100000 --seed 0 --out recordings/doom-maze
# The west room and its corridor (x below 11.9 m) are never seen in training: they are the "new places" of the scorecard.
terrella train video recordings/doom-maze --out runs/doom-maze --config.name doom-maze \
    --config.keep-out 0 -30 11.9 10 --config.steps 7500 --config.motion-steps 5000
mkdir -p src/terrella/bundled
cp -r runs/doom-maze/world src/terrella/bundled/doom-maze
python recipes/doom_maze_score.py recordings/doom-maze scores/doom-maze
