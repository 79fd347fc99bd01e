// <instrument-users>: the administrator's list of users (add, roles, new PIN, remove), and the keys for SSH of the card.

import { sentences } from "../core/api.js";
import { askIfRequired } from "../core/login.js";
import { html, nothing, render } from "../vendor/lit-html.js";
import { t } from "../i18n/translate.js";

const URL = "/api/users", KEYS = "/api/ssh-keys";
const ROLES = ["screener", "reader", "technician", "administrator"];

class InstrumentUsers extends HTMLElement {
  #state = { users: /** @type {any[] | null} */ (null), keys: [], open: "", error: "", message: "" };
  #reload = () => this.#load();

  connectedCallback() {
    document.addEventListener("login-changed", this.#reload);
    this.#load();
  }

  disconnectedCallback() {
    document.removeEventListener("login-changed", this.#reload);
  }

  #set(more) {
    Object.assign(this.#state, more);
    render(view(this.#state, this.#actions), this);
  }

  async #load() {
    const answer = await this.#request("GET", URL);
    const asked = answer && (await this.#request("GET", KEYS));
    if (asked) this.#set({ users: answer.users, keys: asked.keys });
  }

  /** Return the answer to a request, null after a refusal, which is shown; a missing login is asked for. */
  async #request(method, url, body = undefined) {
    const options = { method, cache: /** @type {const} */ ("no-store") };
    if (body) Object.assign(options, { headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) });
    const response = await fetch(url, options).catch(() => null);
    const answer = await response?.json().catch(() => null);
    if (response?.ok && answer) return answer;
    const isAsked = answer?.code && askIfRequired(answer);
    this.#set({ error: isAsked ? "" : answer?.message ? sentences(answer) : t("tech.lost"), message: "" });
    return null;
  }

  async #change(method, url, body, message) {
    if (!(await this.#request(method, url, body))) return;
    this.#set({ open: "", error: "", message });
    await this.#load();
  }

  #actions = {
    open: (name) => this.#set({ open: this.#state.open === name ? "" : name, error: "", message: "" }),

    add: (event) => {
      event.preventDefault();
      const { name, secret, roles } = typed(event.target);
      this.#change("POST", URL, { name, secret, roles }, t("users.added", { name }));
    },

    save: (event, name) => {
      event.preventDefault();
      const { secret, roles } = typed(event.target);
      this.#change("PATCH", `${URL}/${encodeURIComponent(name)}`, { roles, ...(secret && { secret }) }, t("users.saved", { name }));
    },

    remove: (name) => this.#change("DELETE", `${URL}/${encodeURIComponent(name)}`, undefined, t("users.removed", { name })),
    decide: (fingerprint, confirmed) => this.#change("POST", KEYS, { fingerprint, confirmed }, t("ssh.decided")),
    differ: () => this.#set({ error: t("login.differ"), message: "" }),
  };
}

customElements.define("instrument-users", InstrumentUsers);

function typed(form) {
  const data = new FormData(form);
  return { name: String(data.get("name") ?? ""), secret: String(data.get("secret")), roles: data.getAll("role") };
}

function view({ users, keys, open, error, message }, actions) {
  return html`
    <h2>${t("section.users")}</h2>
    ${error ? html`<p class="bad" role="alert">${error}</p>` : nothing}
    <p role="status">${message}</p>
    <ul class="users">${(users ?? []).map((user) => row(user, open === user.name, actions))}</ul>
    ${users ? form("", null, actions) : nothing}
    ${keys.length ? html`<h3>${t("ssh.title")}</h3><p>${t("ssh.about")}</p>${keys.map((key) => sshKey(key, actions))}` : nothing}
  `;
}

function row(user, isOpen, actions) {
  return html`<li>
    <button type="button" aria-expanded=${isOpen} @click=${() => actions.open(user.name)}>
      <b>${user.name}</b> ${user.roles.map((role) => t(`role.${role}`)).join(", ")}
    </button>
    ${isOpen ? form(user.name, user, actions) : nothing}
  </li>`;
}

function sshKey({ fingerprint, comment, confirmed }, { decide }) {
  const state = confirmed === null ? "ssh.asked" : confirmed ? "ssh.confirmed" : "ssh.refused";
  return html`<div class="card">
    <p><b>${comment}</b> <code>${fingerprint}</code>: ${t(state)}</p>
    <button type="button" @click=${() => decide(fingerprint, true)}>${t("ssh.confirm")}</button>
    <button type="button" @click=${() => decide(fingerprint, false)}>${t("ssh.refuse")}</button>
  </div>`;
}

/** Form of a new user, or of the roles and a new PIN of a known one; the PIN is typed twice. */
function form(name, user, actions) {
  const submit = (event) => {
    const { secret, again } = event.target.elements;
    if (secret.value === again.value) return user ? actions.save(event, name) : actions.add(event);
    event.preventDefault();
    return actions.differ();
  };
  return html`<form class="card" autocomplete="off" @submit=${submit}>
    ${user ? nothing : html`<h3>${t("users.new")}</h3><label class="field">${t("login.name")}<input name="name" maxlength="40" required /></label>`}
    <fieldset>
      <legend>${t("users.roles")}</legend>
      ${ROLES.map((role) => html`<label><input type="checkbox" name="role" value=${role} .checked=${Boolean(user?.roles.includes(role))} /> ${t(`role.${role}`)}</label>`)}
    </fieldset>
    <label class="field">${t("login.new")}<input name="secret" type="password" maxlength="200" ?required=${!user} autocomplete="new-password" /></label>
    <label class="field">${t("login.again")}<input name="again" type="password" maxlength="200" ?required=${!user} autocomplete="new-password" /></label>
    <button class="primary" type="submit">${t(user ? "users.save" : "users.add")}</button>
    ${user ? html`<button type="button" @click=${() => actions.remove(name)}>${t("users.remove", { name })}</button>` : nothing}
  </form>`;
}
