// History screen: patients of a day. Loaded on demand.

import { patientList } from "./home.js";
import { icon } from "../components/icons.js";
import { choice } from "../components/components.js";
import { html } from "../vendor/lit-html.js";
import { calendarDay, isoDay, t, today } from "../i18n/translate.js";

/** @typedef {import("../core/state.js").State} State */

const FILTERS = {
  all: () => true,
  open: ({ finished_at: end }) => !end,
  referred: ({ outcome }) => Boolean(outcome?.code.startsWith("refer")),
  declined: ({ outcome }) => outcome?.code === "declined",
};

/** @param {State} state */
export function history(state, actions) {
  const { visits, listFilter, route, status } = state;
  const filters = status?.sending ? [...Object.keys(FILTERS), "waiting"] : Object.keys(FILTERS);
  const day = route.day ?? today();
  const listed = (visits ?? []).filter(FILTERS[listFilter]);
  const step = (days) => () => actions.go({ screen: "history", day: shiftDay(day, days) });
  return html`
    <section class="history">
      <h2>${t("history.title")}</h2>
      <div class="days" data-repeat role="group" aria-label=${t("history.day")}>
        <button type="button" id="before" @click=${step(-1)}>${icon("left")} <span>${t("history.before")}</span></button>
        <p aria-live="polite">${calendarDay(`${day}T12:00`)}</p>
        <button type="button" id="after" ?disabled=${day >= today()} @click=${step(1)}>
          <span>${t("history.after")}</span> ${icon("next")}
        </button>
      </div>
      ${choice({
        label: t("history.title"),
        value: listFilter,
        options: filters.map((name) => [name, t(`show.${name}`)]),
        choose: (name) => (name === "waiting" ? actions.go({ screen: "send" }) : actions.setListFilter(name)), // the queue holds all days
      })}
      ${listed.length ? patientList(listed, actions.openPictures) : html`<p class="muted">${t("history.none")}</p>`}
    </section>
  `;
}

const shiftDay = (day, days) => {
  const date = new Date(`${day}T12:00`);
  date.setDate(date.getDate() + days);
  return isoDay(date);
};
