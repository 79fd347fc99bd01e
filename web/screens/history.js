// History: the people of a day, the pictures of a person, and two pictures compared with the same zoom. Loaded when first opened.

import { zipOf } from "../api.js";
import { people } from "./home.js";
import { ending, openAgain } from "./outcome.js";
import { icon } from "../icons.js";
import { choice, numberWords, slotWords, thumb } from "../parts.js";
import { html, nothing } from "../vendor/lit-html.js";
import { calendarDay, clockTime, dayName, t, today } from "../words.js";

const KEEP = {
  all: () => true,
  open: ({ finished_at: end }) => !end,
  referred: ({ outcome }) => Boolean(outcome?.code.startsWith("refer")),
};

export function history(state, act) {
  const { visits, onlyShow, route, status } = state;
  const filters = status?.sending ? [...Object.keys(KEEP), "waiting"] : Object.keys(KEEP);
  const day = route.day ?? today();
  const listed = (visits ?? []).filter(KEEP[onlyShow]);
  const step = (days) => () => act.go({ screen: "history", day: shifted(day, days) });
  return html`
    <section class="history">
      <h2>${t("history.title")}</h2>
      <div class="days" role="group" aria-label=${t("history.day")}>
        <button type="button" id="before" @click=${step(-1)}>${icon("left")} <span>${t("history.before")}</span></button>
        <p aria-live="polite">${calendarDay(`${day}T12:00`)}</p>
        <button type="button" id="after" ?disabled=${day >= today()} @click=${step(1)}>
          <span>${t("history.after")}</span> ${icon("next")}
        </button>
      </div>
      ${choice({
        label: t("history.title"),
        value: onlyShow,
        options: filters.map((name) => [name, t(`show.${name}`)]),
        choose: (name) => (name === "waiting" ? act.go({ screen: "send" }) : act.only(name)), // of all days
      })}
      ${listed.length ? people(listed, act.openFilm) : html`<p class="muted">${t("history.none")}</p>`}
    </section>
  `;
}

const shifted = (day, days) => {
  const date = new Date(`${day}T12:00`);
  date.setDate(date.getDate() + days);
  return dayName(date);
};

// ---- one person's pictures

export function film(state, act) {
  const { visit, picked } = state;
  if (!visit) return nothing;
  const taken = Object.entries(visit.slots).flatMap(([slot, { captures }]) => captures.map((id) => ({ slot, id })));
  return html`
    <section class="film">
      <h2>${t("film.title", { number: numberWords(visit.number) })}</h2>
      ${visit.outcome ? html`<p>${ending(state).filter(Boolean).join(" · ")}</p>` : nothing}
      ${taken.length ? html`<ul>${taken.map((one) => frame(state, act, one))}</ul>` : html`<p>${t("film.none")}</p>`}
      <div class="ends">
        ${picked.length === 2
          ? html`<button class="primary" type="button" id="compare" @click=${act.compare}>${t("film.compare")}</button>`
          : taken.length > 1
            ? html`<p class="muted">${t("film.pick", { n: 2 - picked.length })}</p>`
            : nothing}
        ${visit.finished_at
          ? openAgain(visit, act)
          : html`<button type="button" @click=${() => act.resume(visit)}>
              ${t("home.continue", { number: numberWords(visit.number) })}
            </button>`}
      </div>
      ${taken.length ? away(state, act) : nothing}
    </section>
  `;
}

/** Which eye and place, and which of several tries. */
function nameOf(state, id) {
  const [slot, { captures }] = Object.entries(state.visit?.slots ?? {}).find(([, one]) => one.captures.includes(id)) ?? [];
  if (!slot) return "";
  return t(captures.length > 1 ? "film.name.n" : "film.name", { ...slotWords(state, slot), n: captures.indexOf(id) + 1 });
}

/** Of several tries: whether this is the one that counts. */
const isUsed = ({ visit }, id) =>
  Object.values(visit?.slots ?? {}).some(({ capture, captures }) => capture === id && captures.length > 1);
const used = (state, id) =>
  isUsed(state, id) ? html`<span class="used">${icon("check")} ${t("film.used")}</span>` : nothing;

function frame(state, act, { slot, id }) {
  const on = state.picked.includes(id);
  return html`<li>
    <button type="button" class="open" data-id=${id} @click=${() => act.openPicture(slot, id)}>
      <span class="thumb">${thumb(id, act)}</span> <span>${nameOf(state, id)}</span>
      ${used(state, id)}
    </button>
    <button type="button" class="pick" aria-pressed=${on} @click=${() => act.pick(id)}>
      ${icon(on ? "check" : "circle")} ${t(on ? "film.picked" : "film.compare")}
    </button>
  </li>`;
}

function away({ visit, folders, copied, zipped }, act) {
  const said = copied ? t("film.copied", { folder: copied }) : folders?.length === 0 ? t("film.nofolder") : "";
  return html`
    <div class="ends">
      <a class="button" href=${zipOf(visit.id)} download @click=${act.zipped}>${t("film.zip")}</a>
      <button type="button" id="copy" @click=${act.listFolders}>${t("film.copy")}</button>
      ${(folders ?? []).map(
        (stick) => html`<button type="button" data-folder=${stick.id} @click=${() => act.copyTo(stick)}>
          ${stick.name}
        </button>`,
      )}
    </div>
    <p role="note">${zipped ? t("film.zipped") : said}</p>
  `;
}

// ---- two pictures: side by side, or one over the other

export function compare(state, act) {
  const { blink, redfree, loupe, route, front = 0 } = state;
  return html`
    <section class="compare" ?data-blink=${blink}>
      <div class="ends">
        ${choice({
          label: t("compare.title"),
          value: Boolean(blink),
          options: [
            [false, t("compare.side")],
            [true, t("compare.blink")],
          ],
          choose: act.setBlink,
        })}
        <button type="button" aria-pressed=${redfree} @click=${() => act.setRedfree(!redfree)}>${t("tool.redfree")}</button>
        <button type="button" id="loupe" aria-pressed=${loupe} @click=${() => act.setLoupe(!loupe)}>${t("tool.loupe")}</button>
        ${blink
          ? html`<button class="primary" type="button" id="swap" @click=${act.swap}>
              ${t("compare.swap", { name: nameOf(state, front ? route.capture : route.other) })}
            </button>`
          : nothing}
      </div>
      <div class="two">${[0, 1].map((i) => side(state, act, i))}</div>
    </section>
  `;
}

function side(state, act, i) {
  const { route, status, blink, front = 0, redfree, loupe } = state;
  const id = [route.capture, route.other][i];
  const taken = state.compared.find((one) => one.id === id);
  return html`<figure class=${blink && i !== front ? "behind" : ""}>
    <figcaption><b>${nameOf(state, id)}</b> ${taken ? clockTime(taken.taken_at) : nothing} ${used(state, id)}</figcaption>
    <eye-pic
      aria-label=${nameOf(state, id)}
      .head=${status}
      .subject=${id}
      .redfree=${redfree}
      .loupe=${loupe}
      .src=${act.finalOf(id)}
      @looked=${act.linkZoom}
      @loupe=${act.heardLoupe}
    ></eye-pic>
  </figure>`;
}
