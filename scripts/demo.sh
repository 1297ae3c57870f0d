#!/usr/bin/env bash
# From nothing to a rendered video: sets up the environment, simulates an event camera in the built-in room, trains,
# evaluates on views it never saw, and renders a flight. Takes a few minutes on a laptop's CPU after installation.
set -euo pipefail
cd "$(dirname "$0")/.."
source scripts/environment.sh test
export PYTHONWARNINGS=ignore
if [ -e demo ]; then
  echo "Error: the folder demo exists already; remove it to run the demo again." >&2
  exit 1
fi

echo "1/4 Simulating an event camera in a furnished room ..."
aenerf simulate --output demo/room --width 160 --height 120 --max-displacement 1 \
  --train-images 20 --validation-views 10 --test-views 10

# The simulated poses are exact: nothing of them is corrected here.
echo "2/4 Training from its events alone (watch it at http://localhost:7007) ..."
ns-train aenerf-small --max-num-iterations 1200 --output-dir demo/outputs \
  --pipeline.model.camera-optimizer.mode off --pipeline.refine-test-poses False \
  --viewer.quit-on-train-completion True --data demo/room
config=$(ls -t demo/outputs/room/aenerf-small/*/config.yml | head -n 1)

echo "3/4 Evaluating on novel views ..."
ns-eval --load-config "$config" --output-path demo/evaluation.json --render-output-path demo/evaluation

echo "4/4 Rendering a video ..."
ns-render interpolate --load-config "$config" --output-path demo/flight.mp4 --order-poses True --interpolation-steps 6

python - <<'PYTHON'
import json

results = json.load(open("demo/evaluation.json"))["results"]
print(f"""
Novel views: PSNR {results['psnr']:.2f} dB, SSIM {results['ssim']:.3f} (color correction {results['color_correction']})
  demo/evaluation/eval_img_*.png    the truth (left) beside what was reconstructed (right)
  demo/evaluation/eval_depth_*.png  its depth
  demo/flight.mp4                   a flight through the reconstructed room
  demo/room/images/                 what a frame camera would have seen""")
PYTHON
