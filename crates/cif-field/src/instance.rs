//! The instance table.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// One instance. Its dense index is its position in [`crate::Field::instances`].
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Instance {
    /// Value in the capture's masks, 1 to 65 535.
    pub id: u16,
    /// Human name, e.g. `red mug`.
    pub label: String,
    /// Class, e.g. `mug`.
    pub category: String,
    /// Names of its class in vocabularies of others by taxonomy, e.g. `wikidata_qcode` and `Q81727`; see
    /// [`cif_output::check_taxonomy`].
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub taxonomies: BTreeMap<String, String>,
}
