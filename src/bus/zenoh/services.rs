//! Serves the parameters, the type descriptions and the lifecycle of a node.

use std::sync::Arc;

use ::zenoh::Wait;
use ::zenoh::liveliness::LivelinessToken;
use ::zenoh::query::{Query, Queryable};
use serde::Serialize;
use serde::de::DeserializeOwned;

use super::names::{Attachment, Endpoint, Kind, dds_type};
use super::node::{Builder, failed, message_endpoint};
use super::parameters::Store;
use super::service_types::{EVENT, Service};
use crate::bus::managed::{ChangeState, Managed, Nothing, TRANSITION_EVENT};
use crate::bus::ros2::{Ros2Error, Ros2Options};
use crate::bus::type_descriptions;
use crate::msgs::{from_cdr, to_cdr};
use crate::system::clock;

/// Depth of the queues of a service, as rmw announces it.
const DEPTH: i32 = 10;

/// A service and its token.
pub(super) struct Server {
    _token: LivelinessToken,
    _queryable: Queryable<()>,
}

impl Builder<'_> {
    /// Offers the services of a node with these parameters.
    pub(super) fn services(&mut self, options: &Ros2Options, store: &Arc<Store>) -> Result<Vec<Server>, Ros2Error> {
        let mut all =
            vec![self.service(options, Service::GetTypeDescription, |request| type_descriptions::answer(&request))?];
        let [get, types, set, set_all, list, describe] = std::array::from_fn(|_| store.clone());
        all.push(self.service(options, Service::GetParameters, move |request| get.get(&request))?);
        all.push(self.service(options, Service::GetParameterTypes, move |request| types.types(&request))?);
        all.push(self.service(options, Service::SetParameters, move |request| set.set(&request))?);
        all.push(self.service(
            options,
            Service::SetParametersAtomically,
            move |request: super::parameters::Wishes| set_all.set_all(&request.parameters),
        )?);
        all.push(self.service(options, Service::ListParameters, move |request| list.list(&request))?);
        all.push(self.service(options, Service::DescribeParameters, move |request| describe.describe(&request))?);
        Ok(all)
    }

    /// Offers the services of a managed node, and the topic of its transitions.
    pub(super) fn lifecycle(&mut self, options: &Ros2Options, managed: Managed) -> Result<Vec<Server>, Ros2Error> {
        let name = options.args.topic(TRANSITION_EVENT, &self.key.namespace, &self.key.name);
        let events = self.out(Kind::Publisher, &message_endpoint(EVENT, name)?)?;
        let node = Arc::new(managed);
        let [changing, current, available] = std::array::from_fn(|_| node.clone());
        Ok(vec![
            self.service(options, Service::ChangeState, move |asked: ChangeState| {
                // Without it a peer still learns of the change from the answer.
                changing.change(&asked, |event| drop(events.put(TRANSITION_EVENT, &event)))
            })?,
            self.service(options, Service::GetState, move |_: Nothing| current.state())?,
            self.service(options, Service::GetAvailableStates, |_: Nothing| Managed::states())?,
            self.service(options, Service::GetAvailableTransitions, move |_: Nothing| available.transitions())?,
            self.service(options, Service::GetTransitionGraph, |_: Nothing| Managed::graph())?,
        ])
    }

    fn service<Request: DeserializeOwned, Response: Serialize>(
        &mut self,
        options: &Ros2Options,
        service: Service,
        answer: impl Fn(Request) -> Response + Send + Sync + 'static,
    ) -> Result<Server, Ros2Error> {
        let private = format!("~/{}", service.name());
        let name = options.args.topic(&private, &self.key.namespace, &self.key.name);
        let hash = service.hash().map_err(|error| Ros2Error::Zenoh(format!("{name}: {error}")))?;
        let dds_type = dds_type(service.type_name());
        let endpoint = Endpoint { name, dds_type, hash, depth: DEPTH, ..Endpoint::default() };
        let respond = move |query: Query| {
            // A request that cannot be read gets no answer, as from rmw_zenoh; its client gives up.
            let _ = reply(&query, &answer);
        };
        let queryable = self.session.declare_queryable(self.key(&endpoint)).complete(true).callback(respond).wait();
        let queryable = queryable.map_err(failed(&endpoint.name))?;
        Ok(Server { _token: self.token(Kind::Server, &endpoint)?.0, _queryable: queryable })
    }
}

/// Answers a request; `None` if it cannot be read or answered.
fn reply<Request: DeserializeOwned, Response: Serialize>(
    query: &Query,
    answer: impl Fn(Request) -> Response,
) -> Option<()> {
    let asked = Attachment::from_bytes(&query.attachment()?.to_bytes())?;
    let request = from_cdr(&query.payload()?.to_bytes()).ok()?;
    let response = to_cdr(&answer(request)).ok()?;
    // The client recognises its request by its number and its own identity.
    let attachment = Attachment { published_ns: clock::now_ns(), ..asked };
    query.reply(query.key_expr().clone(), response).attachment(attachment.to_bytes().to_vec()).wait().ok()
}
