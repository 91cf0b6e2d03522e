# Makes an environment of its own with the real lerobot package (it cannot share ours), and prints its python.
# Usage: sh tests/lerobot_setup.sh FOLDER. Where it cannot be made, says so loudly on stderr and prints nothing.
folder="$1"
python="$folder/bin/python"
if [ -e "$folder/.ready" ]; then
    echo "$python"
    exit 0
fi
pip() { "$python" -m pip install --disable-pip-version-check -q "$@" >&2; }
# lerobot pins older versions of nearly everything; on a CPU these are known to read and write datasets together.
python3 -m venv --clear "$folder" >&2 &&
    pip torch==2.13.0 &&
    pip --no-deps torchvision==0.28.0 lerobot==0.4.4 torchcodec==0.13.0 &&
    pip "datasets>=4,<5" "av<16" "huggingface-hub<0.36" jsonlines einops "opencv-python-headless<4.13" pillow \
        draccus==0.10.0 termcolor deepdiff "imageio[ffmpeg]" accelerate "diffusers<0.36" "pyserial<4" gymnasium \
        numba &&
    { command -v ffmpeg >/dev/null || apt-get -o DPkg::Lock::Timeout=300 install -y -q ffmpeg >&2; } &&
    touch "$folder/.ready" && echo "$python" && exit 0
echo "SKIPPED: no environment with lerobot 0.4.4 could be made in $folder; the tests against it are not run." >&2
