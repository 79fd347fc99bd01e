// Inline SVG icons, so that none is fetched. Each icon accompanies a text, so it is hidden from screen readers.

import { html, svg } from "../vendor/lit-html.js";

const PATHS = {
  ring: svg`<circle cx="12" cy="12" r="9" stroke-dasharray="4 2.6"></circle><circle cx="12" cy="12" r="1.5"></circle>`,
  hand: svg`<path
    d="M8 13V5.5a1.5 1.5 0 0 1 3 0V11M11 11V4a1.5 1.5 0 0 1 3 0v7M14 11V5.5a1.5 1.5 0 0 1 3 0V14c0 4-2.5 7-6 7
       -3 0-4.5-1.5-6-4l-1.7-3a1.5 1.5 0 0 1 2.5-1.6L8 15"></path>`,
  circle: svg`<circle cx="12" cy="12" r="9"></circle>`,
  check: svg`<path d="M4 12.5 9.5 18 20 6.5"></path>`,
  cross: svg`<path d="M6 6l12 12M18 6 6 18"></path>`,
  again: svg`<path d="M4 12a8 8 0 1 0 2.5-5.8M4 4v4.5h4.5"></path>`,
  next: svg`<path d="M5 12h14M13 6l6 6-6 6"></path>`,
  left: svg`<path d="M19 12H5M11 6l-6 6 6 6"></path>`,
  up: svg`<path d="M12 19V5M6 11l6-6 6 6"></path>`,
  down: svg`<path d="M12 5v14M6 13l6 6 6-6"></path>`,
  sun: svg`<circle cx="12" cy="12" r="4"></circle><path d="M12 3v2M12 19v2M3 12h2M19 12h2M6 6l1 1M17 17l1 1M18 6l-1 1M6 18l1-1"></path>`,
  pen: svg`<path d="M5 19l1-4L16 5l3 3L9 18z"></path>`,
  warn: svg`<path d="M12 4 2.5 20h19zM12 10v4.5M12 17.2v.3"></path>`,
  wait: svg`<circle cx="12" cy="12" r="9"></circle><path d="M12 7v5l3.5 2"></path>`,
  menu: svg`<path d="M4 7h16M4 12h16M4 17h16"></path>`,
  person: svg`<circle cx="12" cy="8" r="4"></circle><path d="M4 21c0-4.5 3.5-7 8-7s8 2.5 8 7"></path>`,
  loud: svg`<path d="M4 9.5v5h3.5L12 18.5v-13L7.5 9.5zM15.5 9a4.5 4.5 0 0 1 0 6M18 6.5a8 8 0 0 1 0 11"></path>`,
  read: svg`<path d="M12 6.5C10 5 7 4.5 3.5 4.5v13c3.5 0 6.5.5 8.5 2 2-1.5 5-2 8.5-2v-13c-3.5 0-6.5.5-8.5 2zM12 6.5v13"></path>`,
  camera: svg`<circle cx="12" cy="13" r="3.5"></circle>
    <path d="M4 8h3.5L9 5.5h6L16.5 8H20a1 1 0 0 1 1 1v9a1 1 0 0 1-1 1H4a1 1 0 0 1-1-1V9a1 1 0 0 1 1-1z"></path>`,
  nolink: svg`<path
    d="M3 3l18 18M5 12.5a10 10 0 0 1 4-2.4M15.5 10.3a10 10 0 0 1 3.5 2.2M8.5 16a5 5 0 0 1 7 0M12 19.5v.1"></path>`,
};

/** Drawing of where the optic disc belongs in the picture: in the centre, or beside it on the nasal side. */
export const target = (eye, field) => html`<svg class="icon target" viewBox="0 0 24 24" aria-hidden="true" focusable="false">
  <circle cx="12" cy="12" r="11"></circle>
  <circle class="disc" cx=${field === "nerve" ? 12 : eye === "OD" ? 18 : 6} cy="12" r="2.5"></circle>
</svg>`;

export function icon(name) {
  return html`<svg class="icon" viewBox="0 0 24 24" aria-hidden="true" focusable="false">${PATHS[name]}</svg>`;
}
