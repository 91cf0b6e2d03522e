#!/bin/sh
# A teacher of eight steps a frame, its one-step student, and the student trained on its own dreams: Doom from pictures and
# actions alone, 48x64. Run it in the folder of a checkout after `make test`; every command goes on where it was stopped.
set -e
PATH=.venv/bin:$PATH
export OMP_NUM_THREADS=1
[ -d recordings/doom-maze ] || terrella record doom --scenario my_way_home --frames 100000 --seed 0 --out recordings/doom-maze
terrella train video recordings/doom-maze --out runs/few-teacher --name teacher --no-geometry --size 48 64 \
    --channels 24 48 96 128 --flow-steps 8 --batch 16 --steps 8000 --doubt-frames 0
terrella train distil runs/few-teacher --data recordings/doom-maze --out runs/few-student
terrella train dreams runs/few-student --teacher runs/few-teacher --data recordings/doom-maze --out runs/few-dreams
terrella record doom --scenario my_way_home --frames 24000 --seed 1 --out recordings/doom-maze-test
for run in few-teacher few-student few-dreams; do
    terrella score runs/$run --data recordings/doom-maze-test --fresh --out scores/$run
done
