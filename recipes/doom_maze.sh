#!/bin/sh
# Makes the bundled world doom-maze from nothing, in the folder of a checkout after `make test`: record, train, put in
# place, score. Measured on two cores: recording 7 minutes and 3, training 52 on one core, scoring 18.
set -e
PATH=.venv/bin:$PATH
terrella record doom --scenario my_way_home --frames 100000 --seed 0 --out recordings/doom-maze
# The west room and its corridor (x below 11.9 m) are never seen in training: they are the "new places" of the scorecard.
OMP_NUM_THREADS=1 terrella train video recordings/doom-maze --out runs/doom-maze --name doom-maze \
    --keep-out 0 -30 11.9 10 --steps 9000 --motion-steps 5000
# The run ends with an estimator for lone pictures and an uncertainty that says when it invents. Those of the bundled world were
# given to it afterwards, in 11 minutes beside other work, from a recording made by the line above:
#   terrella train uncertainty doom-maze --data recordings/doom-maze --out runs/sensing --estimator-steps 1600 --uncertainty-frames 3500
# How its position drifts was fitted later, by fit_drift of learn/objectives/drift.py on rollouts of several policies: docs/lab/log.md.
mkdir -p src/terrella/bundled
rm -rf src/terrella/bundled/doom-maze
cp -r runs/doom-maze/world src/terrella/bundled/doom-maze
# Scores come from a recording of its own, of which training saw nothing.
terrella record doom --scenario my_way_home --frames 40000 --seed 1 --out recordings/doom-maze-test
python recipes/doom_maze_score.py recordings/doom-maze-test scores/doom-maze
