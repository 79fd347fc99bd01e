// The technician's rooms beside the calibration: each is an element that asks the instrument for what it shows.

import "./diary.js";
import "./explorer.js";
import "./health.js";
import "./update.js";
import { html } from "./vendor/lit-html.js";
import { t } from "./words.js";

const ROOMS = {
  calibration: null, // the wizard's own
  health: html`<instrument-health class="column"></instrument-health>`,
  explorer: html`<accuracy-time class="column"></accuracy-time>`,
  diary: html`<instrument-diary class="column"></instrument-diary>`,
  update: html`<software-update class="column"></software-update>`,
};

/** The way from room to room, and the room; `calibration` is the one that the wizard draws. */
export function rooms(state, act, calibration) {
  return html`
    <nav class="rooms" aria-label=${t("rooms")}>
      ${Object.keys(ROOMS).map((name) => html`<button
        type="button" data-room=${name} aria-current=${name === state.room ? "page" : "false"} @click=${() => act.enterRoom(name)}
      >${t(`room.${name}`)}</button>`)}
    </nav>
    ${ROOMS[state.room] ?? calibration(state, act)}
  `;
}
