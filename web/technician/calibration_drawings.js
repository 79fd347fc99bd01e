// Drawings of the calibration steps: camera on the left, target on the right. The text beside each says the same, so
// screen readers skip them.
// Of a trial lens: lens and trainer eye beside the camera; of a cylinder its axis as the examiner sees it.

import { html, nothing, svg } from "../vendor/lit-html.js";

const CAMERA = svg`
  <path class="part" d="M6 34h44a6 6 0 0 1 6 6v40a6 6 0 0 1-6 6H6z"></path>
  <path class="part" d="M56 44h24v32H56z"></path>
  <path class="thin" d="M16 50v20M24 46v28"></path>`;

const STANDS = {
  cap: svg`
    <path class="bold" d="M74 38h18v44H74z"></path>
    <path class="thin" d="M112 28 98 36M116 60h-16M112 92 98 84"></path>
    <path class="accent" d="M136 60h34M150 50l-14 10 14 10"></path>`,
  screen: svg`
    <path class="light" d="M170 14h16v92h-16z"></path>
    <path class="accent" d="M160 26h-64M160 48H92M160 72H92M160 94h-64"></path>`,
  point: svg`
    <path class="thin dashed" d="M84 60h100"></path>
    <path class="accent" d="M178 57 84 46M178 63 84 74"></path>
    <circle class="light" cx="184" cy="60" r="6"></circle>
    <path class="part" d="M192 30h10v60h-10z"></path>`,
};

export function drawing(stand) {
  return html`<svg class="drawing" viewBox="0 0 210 120" aria-hidden="true" focusable="false">
    ${CAMERA} ${STANDS[stand] ?? nothing}
  </svg>`;
}

const EYE = svg`
  <path class="thin dashed" d="M84 60h66"></path>
  <circle class="part" cx="178" cy="60" r="26"></circle>
  <path class="part" d="M155 49c-8 6-8 16 0 22"></path>`;
const LENS = svg`
  <path class="accent" d="M128 34c8 15 8 37 0 52c-8-15-8-37 0-52z"></path>
  <path class="thin" d="M128 96v12M151 96v12M128 102h23"></path>`;

function dial(axis) {
  return svg`
    <circle class="part" cx="56" cy="60" r="42"></circle>
    <path class="thin" d="M56 18v10M56 102v-10M14 60h10M98 60h-10"></path>
    <text x="102" y="52">0°</text>
    <text x="66" y="15">90°</text>
    <path class="accent" transform="rotate(${-axis} 56 60)" d="M14 60h84"></path>`;
}

/** Drawing of a lens of the trial case before the trainer eye. */
export function lensDrawing({ sphere_dpt: sphere, cylinder_dpt: cylinder, axis_deg: axis }) {
  return html`<svg class="drawing" viewBox="0 0 210 120" aria-hidden="true" focusable="false">
    ${cylinder ? dial(axis) : CAMERA} ${EYE} ${sphere || cylinder ? LENS : nothing}
  </svg>`;
}
