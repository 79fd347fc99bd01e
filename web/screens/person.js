// Person: first the one question that must be asked, then tiles that can wait. Nothing has to be typed.

import { icon } from "../icons.js";
import { choice, pad, typedBy } from "../parts.js";
import { html, nothing } from "../vendor/lit-html.js";
import { t } from "../words.js";

const LADDER = ["6/6", "6/9", "6/12", "6/18", "6/24", "6/36", "6/60", "CF", "HM", "LP", "NLP"];
const seen = (value) => [value, value.startsWith("6/") ? value : t(`vision.${value}`)];
const options = (prefix, values) => values.map((value) => [value, t(`${prefix}.${value}`)]);
const URGENT = ["sudden_loss", "pain"];

// What is asked, in this order: the answers of each question as tiles.
const QUESTIONS = [
  ["complaints", () => options("complaint", ["sudden_loss", "flashes", "pain", "red", "none"])],
  ["sex", () => options("sex", ["woman", "man", "other"])],
  ["age", null],
  ["diabetes", () => options("diabetes", ["yes", "no", "unknown"])],
  ["diabetes_years", () => options("years", ["<1", "1-5", "5-10", ">10", "unknown"])],
  ["vision_od", () => LADDER.map(seen)],
  ["vision_os", () => LADDER.map(seen)],
  ["glasses", () => [["yes", t("yes")], ["no", t("no")]]],
  ["drops_od", () => [[true, t("drops.given")], [false, t("drops.none")]]],
  ["drops_os", () => [[true, t("drops.given")], [false, t("drops.none")]]],
];

// Drops are kept as the moment at which they were given: an hour later the pupil is another.
const isDrops = (name) => name.startsWith("drops_");
const sentAs = (name, one) => (isDrops(name) ? (one ? new Date().toISOString() : null) : one);

export function person(state, act) {
  const { visit, later } = state;
  if (!visit) return nothing;
  const { fields, waiting = [] } = visit;
  const asked = QUESTIONS.filter(([name]) => name !== "diabetes_years" || fields.diabetes === "yes");
  return html`
    <section class="person">
      <h2>${t("consent")}</h2>
      ${later.aloud?.toAsk(state) ?? nothing}
      ${choice({
        label: t("consent"),
        field: "consent",
        value: fields.consent,
        options: options("consent", ["agreed", "declined"]),
        choose: (value) => act.setField("consent", value),
      })}
      ${shoot(state, act)} ${waiting.length ? html`<p class="muted" id="unsaved">${t("save.waiting")}</p>` : nothing}
      <h2>${t("person.details")}</h2>
      <div class="questions">${asked.map(([name, answers]) => question(state, act, name, answers))}</div>
      ${typedWords(state, act)}
    </section>
  `;
}

function shoot({ visit, protocol }, act) {
  const { consent } = visit.fields;
  const any = Object.values(visit.slots).some(({ captures }) => captures.length);
  if (consent === "declined") {
    return html`<div class="go">
      <button class="primary big" type="button" id="finish" @click=${act.finish}>
        <span>${t("result.finish")}<small>${t("person.declined")}</small></span>
      </button>
    </div>`;
  }
  const ready = consent === "agreed" && protocol !== null;
  return html`<div class="go">
    <button class="primary big" type="button" id="shoot" aria-disabled=${!ready} @click=${() => ready && act.shoot()}>
      ${icon("camera")} <span>${t(ready ? "person.shoot" : "person.ask")}</span>
    </button>
    ${any
      ? html`<button type="button" id="film" @click=${() => act.go({ screen: "film", visit: visit.id })}>
          ${t("person.film")}
        </button>`
      : nothing}
  </div>`;
}

function question({ visit }, act, name, answers) {
  const label = t(`field.${name}`);
  const value = visit.fields[name];
  if (name === "age") return age(value, act);
  const many = name === "complaints";
  const choose = (one) => act.setField(name, many ? toggled(value ?? [], one) : sentAs(name, one));
  const chosen = isDrops(name) && value !== undefined ? value !== null : value;
  const urgent = many && (value ?? []).some((one) => URGENT.includes(one));
  return html`
    <div class="question">
      <h3>${label}</h3>
      ${choice({ label, field: name, value: chosen, options: answers(), choose, many })}
      ${urgent ? html`<p class="urgent" role="note">${icon("warn")} ${t("complaint.urgent")}</p>` : nothing}
    </div>
  `;
}

/** "None" and a complaint exclude each other; nothing chosen is no answer. */
function toggled(before, one) {
  if (before.includes(one)) return orNull(before.filter((other) => other !== one));
  return one === "none" ? ["none"] : [...before.filter((other) => other !== "none"), one];
}

const orNull = (list) => (list.length ? list : null);

function age(value, act) {
  const press = (key) => {
    const typed = typedBy(String(value ?? ""), key, 3);
    act.setField("age", typed === "" ? null : Math.min(Number(typed), 120));
  };
  return html`
    <div class="question">
      <h3>${t("field.age")} <output class="typed">${value ?? ""}</output></h3>
      ${pad(press)}
    </div>
  `;
}

function typedWords({ visit }, act) {
  const box = (name, type) => html`
    <label class="typing">
      <span>${t(`field.${name}`)}</span>
      <input
        type=${type}
        name=${name}
        maxlength="120"
        autocomplete="off"
        .value=${visit.fields[name] ?? ""}
        @change=${({ target }) => act.setField(name, target.value.trim() || null)}
      />
    </label>
  `;
  return html`<details>
    <summary>${t("person.words")}</summary>
    ${box("name", "text")} ${box("phone", "tel")} ${box("village", "text")}
  </details>`;
}
