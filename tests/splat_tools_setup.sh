# Installs what other projects read and write Gaussians with into a folder of its own, and prints it: nothing of it is part of Terrella.
# Usage: sh tests/splat_tools_setup.sh FOLDER PYTHON. Where it cannot be made, says so loudly on stderr and prints nothing.
folder="$1"
python="${2:-python3}"
if [ ! -e "$folder/.ready-1" ]; then
    command -v npm >/dev/null || { echo "SKIPPED: no npm here; files are not tried in Spark, three.js and PlayCanvas." >&2; exit 0; }
    mkdir -p "$folder" &&
        npm install --prefix "$folder" --ignore-scripts --no-audit --no-fund --loglevel=error \
            three@0.187.0 @sparkjsdev/spark@2.2.0 playcanvas@2.23.3 @playcanvas/splat-transform@2.7.1 >&2 &&
        "$python" -m pip install --disable-pip-version-check -q --no-deps --target "$folder/python" gsply==0.4.6 >&2 &&
        touch "$folder/.ready-1" ||
        { echo "SKIPPED: other projects' packages could not be installed in $folder; files are not tried in them." >&2; exit 0; }
fi
echo "$folder"
