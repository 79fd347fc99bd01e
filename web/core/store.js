// State store: one frozen object and its listeners.

/**
 * @template {Record<string, any>} T
 * @param {T} initial
 */
export function createStore(initial) {
  /** @type {Readonly<T>} */
  let state = Object.freeze({ ...initial });
  let scheduled = false;
  /** @type {Set<(state: Readonly<T>) => void>} */
  const listeners = new Set();

  const notify = () => {
    scheduled = false;
    for (const listener of listeners) listener(state);
  };

  return {
    get: () => state,

    /**
     * Merge `patch` into the state and notify the listeners once, in a microtask: many changes cause one render.
     * @param {Partial<T>} patch
     */
    set(patch) {
      if (Object.keys(patch).every((key) => Object.is(patch[key], state[key]))) return;
      state = Object.freeze({ ...state, ...patch });
      if (!scheduled) {
        scheduled = true;
        queueMicrotask(notify);
      }
    },

    /** @param {(state: Readonly<T>) => void} listener */
    subscribe(listener) {
      listeners.add(listener);
      return () => listeners.delete(listener);
    },
  };
}
