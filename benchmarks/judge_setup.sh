# Makes an environment of its own with stable-worldmodel and OGBench (their pins are not ours) and this package, and prints its python.
# Usage: sh benchmarks/judge_setup.sh FOLDER. Where it cannot be made, says so on stderr and fails.
folder="$1"
python="$folder/bin/python"
if [ -e "$folder/.ready-2" ]; then
    echo "$python"
    exit 0
fi
pip() { "$python" -m pip install --disable-pip-version-check -q "$@" >&2; }
echo "setting up $folder with stable-worldmodel 0.1.1 and ogbench 1.2.2 (once)" >&2
python3 -m venv --clear "$folder" >&2 &&
    pip torch==2.13.0 torchvision==0.28.0 stable-worldmodel==0.1.1 pygame pymunk shapely opencv-python-headless \
        "imageio[ffmpeg]" scikit-learn h5py hdf5plugin &&
    pip "mujoco>=3.3,<4" dm_control &&
    pip --no-deps ogbench==1.2.2 &&
    pip -e . &&
    touch "$folder/.ready-2" && echo "$python" && exit 0
echo "no environment with stable-worldmodel 0.1.1 could be made in $folder; it needs Python 3.11 or later and the network." >&2
exit 1
