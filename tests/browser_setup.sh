#!/bin/sh
# Sees to it that the browser tests find a Chromium: one that is here, else Debian's, else Playwright's own. Never fails.
# usage: sh tests/browser_setup.sh PYTHON

python=${1:-python3}
[ -n "$TERRELLA_BROWSER" ] && exit 0
for name in chromium chromium-browser google-chrome google-chrome-stable; do
    command -v "$name" >/dev/null 2>&1 && exit 0
done
"$python" - <<'END' >/dev/null 2>&1 && exit 0
import os
from playwright.sync_api import sync_playwright
with sync_playwright() as playwright:
    raise SystemExit(not os.path.exists(playwright.chromium.executable_path))
END
if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null 2>&1; then
    echo "installing Debian's chromium for the browser tests (once)"
    export DEBIAN_FRONTEND=noninteractive
    apt-get -o DPkg::Lock::Timeout=300 install -qq -y --no-install-recommends chromium >/dev/null 2>&1 && exit 0
    apt-get update -qq >/dev/null 2>&1
    apt-get -o DPkg::Lock::Timeout=300 install -qq -y --no-install-recommends chromium >/dev/null 2>&1 && exit 0
fi
echo "installing Playwright's own Chromium for the browser tests (once)"
timeout 600 "$python" -m playwright install chromium >/dev/null 2>&1 && exit 0
echo "no browser could be installed: the browser tests will be skipped; install chromium or set TERRELLA_BROWSER=/path/to/it"
exit 0
