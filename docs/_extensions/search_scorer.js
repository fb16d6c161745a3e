/* Order of search results (html_search_scorer): pages with the words of the query in their title come first, then those
 * with the words in headings and index entries, guides before the glossary, and last pages that only use the terms: API
 * entries, theory and examples. */
const supporting = {reference: -10, faq: -8, gallery: -8, notebooks: -8, coming_from: -8, theory: -4, glossary: -2};
const stems = (text) => {
  const words = text.toLowerCase().split(/[^\p{L}\p{N}]+/u).filter((word) => word && !stopwords.has(word));
  return new Set(words.map((word) => new Stemmer().stemWord(word)));
};

/* Stems in the headings and index entries of each page, by its name. */
let headings = null;
const headings_of_pages = ({docnames, alltitles, indexentries}) => {
  const found = Object.fromEntries(docnames.map((name) => [name, new Set()]));
  for (const [text, places] of [...Object.entries(alltitles), ...Object.entries(indexentries)])
    for (const [page] of places) for (const word of stems(text)) found[docnames[page]].add(word);
  return found;
};

var Scorer = {
  score: ([docname, title, anchor, description, score, filename, kind]) => {
    const query = stems(new URLSearchParams(location.search).get("q") || "");
    const heading = stems(kind === "object" ? "" : title);
    headings ??= headings_of_pages(Search._index);
    const in_title = [...query].filter((word) => heading.has(word)).length;
    const in_headings = [...query].filter((word) => headings[docname].has(word)).length;
    const group = docname.split(/[/_]/)[0];
    const section = docname.startsWith("coming_from") ? "coming_from" : group;
    return score + (10 * (in_title + in_headings)) / Math.max(query.size, 1) + (supporting[section] || 0);
  },
  // Defaults of Sphinx.
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: {0: 15, 1: 5, 2: -5},
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
};

/* Index entries are found in every inflection and order of words ("quaternions", "list of neighbors"). If few pages
 * contain all words, those with all words but one are added at a lower score, and pages with fewer words if there are no
 * others. */
const few = 8, most_for_some_words = 13;
const key = (text) => [...stems(text)].sort().join(" ");
let entries = null;

const searched = (perform, query, terms, ...rest) => {
  const results = perform(entries.get(key(query)) ?? query, terms, ...rest);
  if (terms.size < 2 || new Set(results.map(([page]) => page)).size > few) return results;
  const fewer = (search) => [...terms].flatMap((left) => {
    const others = new Set([...terms].filter((term) => term !== left));
    const words = query.split(/\s+/).filter((word) => !stems(word).has(left));
    return search(words.join(" "), others, ...rest);
  });
  let others = fewer((words, ...more) => perform(entries.get(key(words)) ?? words, ...more));
  if (!others.length && !results.length) others = fewer((...more) => searched(perform, ...more));
  others = others.map((result) => result.with(4, Math.min(result[4] - 12, most_for_some_words)));
  const seen = new Set();
  const first = (result) => !seen.has(result[0]) && seen.add(result[0]);
  return [...results, ...others].sort((a, b) => b[4] - a[4]).filter(first).reverse();
};

if (typeof Search !== "undefined") {
  const perform = Search._performSearch;
  Search._performSearch = (...words) => {
    entries ??= new Map(Object.keys(Search._index.indexentries).map((entry) => [key(entry), entry]));
    return searched(perform, ...words);
  };
}
