// The SQL editor of the page: CodeMirror with highlighting, and completion of tables and columns.

import { autocompletion, completionKeymap } from "@codemirror/autocomplete";
import { defaultKeymap, history, historyKeymap } from "@codemirror/commands";
import { SQLDialect, sql } from "@codemirror/lang-sql";
import { HighlightStyle, bracketMatching, syntaxHighlighting } from "@codemirror/language";
import { EditorState } from "@codemirror/state";
import { EditorView, drawSelection, highlightSpecialChars, keymap } from "@codemirror/view";
import { tags } from "@lezer/highlight";

// CodeMirror expects single spaces between words.
const words = (text) => text.split(/\s+/).join(" ");
const dialect = SQLDialect.define({
  keywords: words(`all and any as asc between by case cross cube desc distinct else end except exclude exists false filter first from
    full group grouping having in inner intersect is join last lateral left like limit natural not null nulls offset on or order
    outer over partition qualify recursive replace right rollup row rows sample select semi sets similar some table then
    true unbounded union unnest using values when where window with`),
  types: "bigint boolean date double float hugeint integer interval list smallint struct text timestamp tinyint varchar",
  builtin: words(`abs acos asin atan2 avg cast ceil coalesce cos count degrees exp floor greatest histogram least list_contains ln
    log10 mag_ab max mean median min mode pi pow quantile_cont radians round separation sin sqrt stddev sum tan try_cast`),
  backslashEscapes: false, doubleDollarQuotedStrings: false, operatorChars: "*+\-%<>!=&|~^/", specialVar: "$",
});
const highlighting = HighlightStyle.define([
  { tag: tags.keyword, color: "var(--accent)", fontWeight: "600" },
  { tag: [tags.string, tags.special(tags.string)], color: "var(--good)" },
  { tag: [tags.number, tags.bool, tags.null], color: "var(--second)" },
  { tag: [tags.comment, tags.lineComment, tags.blockComment], color: "var(--quiet)", fontStyle: "italic" },
  { tag: [tags.standard(tags.name), tags.typeName], color: "var(--second)" },
]);
const theme = EditorView.theme({
  "&": { color: "var(--ink)", backgroundColor: "var(--raised)", border: "1px solid var(--line)", borderRadius: "4px", fontSize: ".88rem" },
  // The page outlines the element around the editor.
  "&.cm-focused": { outline: "none" },
  ".cm-content": { caretColor: "var(--ink)", minHeight: "9rem", padding: ".3rem 0" },
  ".cm-scroller": { fontFamily: '"DejaVu Sans Mono", monospace', maxHeight: "40vh" },
  ".cm-cursor": { borderLeftColor: "var(--ink)" },
  "&.cm-focused > .cm-scroller > .cm-selectionLayer .cm-selectionBackground, .cm-selectionBackground": { background: "color-mix(in srgb, var(--second) 35%, transparent)" },
  "&.cm-focused .cm-matchingBracket": { backgroundColor: "transparent", outline: "1px solid var(--accent)" },
  ".cm-tooltip": { color: "var(--ink)", backgroundColor: "var(--panel)", border: "1px solid var(--line)" },
  ".cm-tooltip.cm-tooltip-autocomplete > ul > li[aria-selected]": { color: "var(--paper)", backgroundColor: "var(--accent)" },
  ".cm-completionDetail": { color: "inherit", fontStyle: "normal", opacity: "1" },
  ".cm-completionInfo": { maxWidth: "18rem" },
});

/** A name as it is written in a query. */
const quoted = (name) => (/^[a-z_][a-z0-9_]*$/.test(name) ? name : `"${name}"`);

const option = (column) => ({
  label: column.name, apply: quoted(column.name), type: "property", detail: column.unit || undefined, info: column.meaning || undefined, boost: 1,
});

/** Nested names for completion after a dot: galaxies -> columns, demo -> galaxies -> columns. */
function schemaOf(tables) {
  const schema = {};
  for (const table of tables) {
    const path = table.name.split("."), name = path.pop();
    let place = schema;
    for (const part of path) place = place[part] ??= {};
    place[name] = table.columns.map(option);
  }
  return schema;
}

/** Complete the columns of all tables that a query names after FROM and JOIN. */
function columnsOf(tables) {
  return (context) => {
    const word = context.matchBefore(/\w+/);
    if (!word || /[.\w"]/.test(context.state.sliceDoc(word.from - 1, word.from))) return null;
    const named = new Set([...context.state.doc.toString().matchAll(/(?:\b(?:from|join)|,)\s+([\w."]+)/gi)].map((found) => found[1].replaceAll('"', "").toLowerCase()));
    const columns = tables.filter((table) => named.has(table.name.toLowerCase())).flatMap((table) => table.columns);
    const options = [...new Map(columns.map((column) => [column.name, option(column)])).values()];
    return options.length ? { from: word.from, options, validFor: /^\w*$/ } : null;
  };
}

/**
 * Open an editor in an element. `facts`: text, tables (name and columns with name, unit, meaning), label (for screen readers), id (of the
 * text field), run (called for Ctrl + Enter) and changed (called after each change).
 */
export function open(host, { text, tables, label, id, run, changed }) {
  // In a shadow root CodeMirror uses constructed style sheets, which the security policy of the page allows.
  const root = host.attachShadow({ mode: "open" });
  const language = sql({ dialect, schema: schemaOf(tables), upperCaseKeywords: true });
  const view = new EditorView({
    root, parent: root,
    state: EditorState.create({
      doc: text,
      extensions: [
        keymap.of([{ key: "Mod-Enter", run: () => (run(), true) }, ...completionKeymap, ...defaultKeymap, ...historyKeymap]),
        history(), drawSelection(), highlightSpecialChars(), bracketMatching(), EditorView.lineWrapping, theme,
        language, language.language.data.of({ autocomplete: columnsOf(tables) }), autocompletion({ icons: false }), syntaxHighlighting(highlighting),
        EditorView.contentAttributes.of({ id, "aria-label": label, spellcheck: "false", autocapitalize: "off" }),
        EditorView.updateListener.of((update) => update.docChanged && changed()),
      ],
    }),
  });
  return {
    text: () => view.state.doc.toString(),
    replace: (other) => view.dispatch({ changes: { from: 0, to: view.state.doc.length, insert: other } }),
    insert: (words) => {
      view.dispatch(view.state.replaceSelection(words));
      view.focus();
    },
  };
}
