// Templates that several views of the technician page share: icon, prompt, error, date.

import { html, nothing, svg } from "../vendor/lit-html.js";
import { calendarDay, clockTime } from "../i18n/translate.js";

const PATHS = {
  warn: svg`<path d="M12 4 2.5 20h19zM12 10v4.5M12 17.2v.3"></path>`,
  done: svg`<path d="M4 12.5 9.5 18 20 6.5"></path>`,
  now: svg`<path d="M5 12h14M13 6l6 6-6 6"></path>`,
  todo: svg`<circle cx="12" cy="12" r="8"></circle>`,
  wait: svg`<circle cx="12" cy="12" r="9"></circle><path d="M12 7v5l3.5 2"></path>`,
};

export const when = (moment) => `${calendarDay(moment)}, ${clockTime(moment)}`;

export function icon(name) {
  return html`<svg class="icon" viewBox="0 0 24 24" aria-hidden="true" focusable="false">${PATHS[name]}</svg>`;
}

export function prompt(tone, text) {
  return html`<p class="prompt" role="status" data-tone=${tone}>${text}</p>`;
}

export function errorBox(error) {
  if (!error) return nothing;
  return html`<div class="alert" role="alert" data-code=${error.code}>
    ${icon("warn")}
    <p><strong>${error.message}</strong> ${error.remedy}</p>
  </div>`;
}
