#!/bin/sh
# Compiles the arithmetic of exported worlds to WebAssembly; needs clang and wasm-ld (Debian: clang, lld).
set -e
cd "$(dirname "$0")/../src/terrella/serve/web/world"
clang --target=wasm32 -O3 -ffast-math -msimd128 -mbulk-memory -ffreestanding -fno-builtin -nostdlib -Wl,--no-entry -Wl,--strip-all \
    -Wl,--export=heap -Wl,--export=convolve -Wl,--export=normalise -Wl,--export=silu -Wl,--export=add -Wl,--export=attend \
    -Wl,--export=unfold -o kernels.wasm kernels.c
