#!/bin/sh
# A teacher of eight steps a frame; one-step students pulled by the truth more and less, and their mean; and a student trained
# on its own dreams: Doom from pictures and actions alone, 48x64. Run it in the folder of a checkout after `make test`; every
# command goes on where it was stopped. About two hours of one core.
set -e
PATH=.venv/bin:$PATH
export OMP_NUM_THREADS=1
# A teacher is not played: it needs no uncertainty, which would take longer to learn than all its students.
data=recordings/doom-maze
[ -d $data ] || terrella record doom --scenario my_way_home --frames 100000 --seed 0 --out $data
terrella train video $data --out runs/few-teacher --name teacher --no-geometry --size 48 64 \
    --channels 24 48 96 128 --flow-steps 8 --batch 16 --steps 8000 --uncertainty-frames 0
terrella train distil runs/few-teacher --data $data --out runs/few-25 --steps 1400 --batch 12
terrella train distil runs/few-teacher --data $data --out runs/few-40 --steps 1400 --batch 12 --truth-weight 0.4
terrella train distil runs/few-teacher --data $data --out runs/few-60 --steps 1000 --batch 12 --truth-weight 0.6
python lab/average.py runs/few-mean runs/few-25:0.4 runs/few-40:0.4 runs/few-60:0.2
terrella train dreams runs/few-25 --teacher runs/few-teacher --data $data --out runs/few-dreams --steps 60
terrella record doom --scenario my_way_home --frames 24000 --seed 1 --out $data-test
for run in few-teacher few-25 few-mean few-dreams; do
    terrella score runs/$run --data $data-test --fresh --out scores/$run
done
