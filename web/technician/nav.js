// Navigation of the technician page; each section is an element that loads its own data.

import "./event_log.js";
import "./accuracy_time.js";
import "./audit.js";
import "./backup.js";
import "./erasure.js";
import "./health.js";
import "./software_update.js";
import "./stored_pictures.js";
import "./ssh_keys.js";
import "./users.js";
import { html } from "../vendor/lit-html.js";
import { t } from "../i18n/translate.js";

const SECTIONS = {
  calibration: null, // drawn by the wizard
  health: html`<instrument-health class="column"></instrument-health>`,
  accuracy: html`<accuracy-time class="column"></accuracy-time>`,
  "event-log": html`<instrument-event-log class="column"></instrument-event-log>`,
  backup: html`<instrument-backup class="column"></instrument-backup>`,
  space: html`<stored-pictures class="column"></stored-pictures>`,
  users: html`<instrument-users class="column"></instrument-users><ssh-keys class="column"></ssh-keys>`,
  erase: html`<patient-erasure class="column"></patient-erasure>`,
  audit: html`<instrument-audit class="column"></instrument-audit>`,
  update: html`<software-update class="column"></software-update>`,
};

/** Navigation bar and current section; `calibration` draws the first one. */
export function navigation(state, actions, calibration) {
  return html`
    <nav class="sections" aria-label=${t("sections")}>
      ${Object.keys(SECTIONS).map((name) => html`<button
        type="button" data-section=${name} aria-current=${name === state.section ? "page" : "false"} @click=${() => actions.openSection(name)}
      >${t(`section.${name}`)}</button>`)}
    </nav>
    ${SECTIONS[state.section] ?? calibration(state, actions)}
  `;
}
